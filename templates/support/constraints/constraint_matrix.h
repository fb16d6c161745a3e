#include "../arrays/arrays.h"
#include "../core/step.h"

/* Sparsity pattern of G M^-1 G^T below its diagonal, by rows: which constraints act on the same coordinates. Requires:
 * list_coordinates. */

/* For each constraint its first entry; for each entry its coordinate (place) and constraint (owner); for each
 * coordinate its first entry (at) in `list`, ordered by constraint; for each row its first pair, for each pair its
 * column; `where` is the index of each column in the row being processed, -1 if absent. */
typedef struct {
  int *first, *place, *owner, *list, *at, *where, *row, *column;
} pattern;

static inline pattern pattern_of(const run_memory *run, long long n)
{
  const long long count = run->constraints, entries = run->entries;
  pattern of = {.first = run->places, .column = run->columns};
  of.place = of.first + count + 1;
  of.owner = of.place + entries;
  of.list = of.owner + entries;
  of.at = of.list + entries;
  of.where = of.at + n + 1;
  of.row = of.where + count;
  return of;
}

static void list_entries(const pattern *of, long long count, long long entries, long long n)
{
  memset(of->at, 0, sizeof(int) * (size_t)(n + 1));
  for (long long e = 0; e < entries; e++)
    of->at[of->place[e] + 1]++;
  for (long long i = 0; i < n; i++)
    of->at[i + 1] += of->at[i];
  for (long long k = 0; k < count; k++)
    for (int e = of->first[k]; e < of->first[k + 1]; e++) {
      of->owner[e] = (int)k;
      of->list[of->at[of->place[e]]++] = e;
    }
  for (long long i = n; i > 0; i--) /* each was advanced to the first of the next */
    of->at[i] = of->at[i - 1];
  of->at[0] = 0;
}

static void sort_ascending(int *numbers, long long count)
{
  for (long long k = 1; k < count; k++) {
    const int number = numbers[k];
    long long place = k;
    for (; place > 0 && numbers[place - 1] > number; place--)
      numbers[place] = numbers[place - 1];
    numbers[place] = number;
  }
}

/* Finds the columns of a row, stored from index `pairs` on; returns the total number of pairs. */
static long long find_row(const pattern *of, int k, long long pairs)
{
  const long long begin = pairs;
  of->row[k] = (int)pairs;
  for (int e = of->first[k]; e < of->first[k + 1]; e++)
    for (int m = of->at[of->place[e]]; m < of->at[of->place[e] + 1]; m++) {
      const int l = of->owner[of->list[m]];
      if (l >= k)
        break;
      if (of->where[l] == k)
        continue;
      of->where[l] = k;
      if (of->column)
        of->column[pairs] = l;
      pairs++;
    }
  if (of->column)
    sort_ascending(of->column + begin, pairs - begin);
  return pairs;
}

/* Computes the pattern of the constraints of a run; returns the number of pairs. */
static long long find_pairs(run_memory *run)
{
  const problem *arrays = &run->data;
  const long long n = coordinates_of(arrays), count = run->constraints;
  const pattern of = pattern_of(run, n);
  condition now = {.first = of.first, .place = of.place};
  long long pairs = 0;
  list_coordinates(arrays, &now);
  of.first[count] = (int)now.entries;
  list_entries(&of, count, now.entries, n);
  for (int k = 0; k < count; k++) {
    of.where[k] = -1;
    pairs = find_row(&of, k, pairs);
  }
  of.row[count] = (int)pairs;
  for (long long k = 0; k < count; k++)
    of.where[k] = -1;
  return pairs;
}

/* Returns 1 if the factorisation of the matrix has no fill-in: rows that share a column contain the first of them
 * (perfect elimination; D. J. Rose, J. Math. Anal. Appl. 32, 1970). */
static int is_without_fill(const run_memory *run)
{
  const pattern of = pattern_of(run, coordinates_of(&run->data));
  int *first = of.where, missing = 0;
  for (int k = 0; k < run->constraints; k++)
    for (int m = of.row[k]; m < of.row[k + 1]; m++) {
      const int column = of.column[m];
      int found = first[column] < 0;
      for (int j = m + 1; j < of.row[k + 1]; j++)
        found |= of.column[j] == first[column];
      missing |= !found;
      if (first[column] < 0)
        first[column] = k;
    }
  for (long long k = 0; k < run->constraints; k++)
    first[k] = -1;
  return !missing;
}

/* Systems with the constraint matrix G M^-1 G^T by its factors L D L^T if these are exact in its pattern, as for a
 * chain or a tree whose constraints are ordered from an end; otherwise by conjugate gradients, preconditioned by the
 * incomplete factorisation without fill (J. A. Meijerink & H. A. van der Vorst, Math. Comp. 31, 1977). Redundant
 * constraints make the matrix singular, which is an error. */

#define LEAST_PIVOT 1e-3 /* relative to the diagonal: a smaller pivot was lost by the incomplete factorisation */
#define DEPENDENT 1e-13 /* of the matrix relative to L D L^T, or of an exact pivot to the diagonal: it counts as 0 */
#define ROUNDING_MULTIPLE 4096.0 /* multiple of the rounding error that may remain at converged positions */
#define SPARE_PRODUCTS 100 /* iterations beyond the number of constraints, to allow for rounding */

/* Arrays of the constraints: one number per constraint (g, g_t, multipliers; right-hand side and residual, solution,
 * three directions of a system, rounding error, diagonal of the matrix and inverted D), per entry (derivatives at the
 * state and at another one), and per pair (the matrix, L). */
typedef struct {
  pattern of;
  long long count, entries, is_exact;
  double *g, *rate, *lambda, *right, *change, *preconditioned, *direction, *image, *rounding, *diagonal, *pivot;
  double *derivative, *next;
  double *entry, *factor;
} constraint_system;

static inline constraint_system constraint_arrays(const run_memory *run, long long n)
{
  constraint_system held = {.of = pattern_of(run, n), .count = run->constraints, .entries = run->entries};
  double **const of_constraints[] = {&held.g, &held.rate, &held.lambda, &held.right, &held.change, &held.preconditioned,
      &held.direction, &held.image, &held.rounding, &held.diagonal, &held.pivot};
  held.is_exact = run->is_exact;
  for (int k = 0; k < 11; k++)
    *of_constraints[k] = run->held + k * held.count;
  held.derivative = run->held + 11 * held.count;
  held.next = held.derivative + held.entries;
  held.entry = held.next + held.entries;
  held.factor = held.entry + run->pairs;
  return held;
}

/* Computes the row of a constraint: products of derivatives with respect to the same coordinates. */
static void find_products(const constraint_system *held, const double *inverse_mass, int k)
{
  const pattern *of = &held->of;
  held->diagonal[k] = 0.0;
  for (int m = of->row[k]; m < of->row[k + 1]; m++) {
    of->where[of->column[m]] = m;
    held->entry[m] = 0.0;
  }
  for (int e = of->first[k]; e < of->first[k + 1]; e++) {
    const int i = of->place[e];
    const double weight = held->derivative[e] * inverse_mass[i];
    for (int m = of->at[i]; m < of->at[i + 1]; m++) {
      const int f = of->list[m], l = of->owner[f];
      if (l > k)
        break;
      if (l == k)
        held->diagonal[k] += weight * held->derivative[f];
      else
        held->entry[of->where[l]] += weight * held->derivative[f];
    }
  }
}

/* Computes a row of L from the rows above; returns 0 if the diagonal is not positive or the row depends on others. */
static int factorise_row(const constraint_system *held, int k)
{
  const pattern *of = &held->of;
  double left = held->diagonal[k];
  for (int m = of->row[k]; m < of->row[k + 1]; m++) {
    const int l = of->column[m];
    double product = held->entry[m], inverse = held->pivot[l];
    for (int j = of->row[l]; j < of->row[l + 1]; j++) {
      const int there = of->where[of->column[j]];
      if (there >= 0)
        product -= held->factor[there] * held->factor[j];
    }
    held->factor[m] = product; /* of L D */
    left -= product * product * inverse;
  }
  for (int m = of->row[k]; m < of->row[k + 1]; m++) {
    held->factor[m] *= held->pivot[of->column[m]];
    of->where[of->column[m]] = -1;
  }
  held->pivot[k] = 1.0 / (held->is_exact || left > LEAST_PIVOT * held->diagonal[k] ? left : held->diagonal[k]);
  if (held->is_exact && !(left > DEPENDENT * held->diagonal[k]))
    return 0;
  return held->diagonal[k] > 0.0 && held->diagonal[k] < INFINITY;
}

/* Assembles and factorises the matrix of the derivatives at the state; returns 0 if a constraint has none. */
static int assemble(const constraint_system *held, const double *inverse_mass)
{
  int sound = 1;
  for (int k = 0; k < held->count; k++) {
    find_products(held, inverse_mass, k);
    sound &= factorise_row(held, k);
  }
  return sound;
}

/* y = G M^-1 G^T x. */
static void multiply(const constraint_system *held, const double *x, double *y)
{
  const pattern *of = &held->of;
  for (int k = 0; k < held->count; k++) {
    double sum = held->diagonal[k] * x[k];
    for (int m = of->row[k]; m < of->row[k + 1]; m++) {
      sum += held->entry[m] * x[of->column[m]];
      y[of->column[m]] += held->entry[m] * x[k];
    }
    y[k] = sum;
  }
}

/* y = (L D L^T)^-1 x. */
static void precondition(const constraint_system *held, const double *x, double *y)
{
  const pattern *of = &held->of;
  for (int k = 0; k < held->count; k++) {
    y[k] = x[k];
    for (int m = of->row[k]; m < of->row[k + 1]; m++)
      y[k] -= held->factor[m] * y[of->column[m]];
  }
  for (int k = 0; k < held->count; k++)
    y[k] *= held->pivot[k];
  for (int k = (int)held->count - 1; k >= 0; k--)
    for (int m = of->row[k]; m < of->row[k + 1]; m++)
      y[of->column[m]] -= held->factor[m] * y[k];
}

/* Inner product in four independent sums, which do not wait for each other. */
static double product_of(const double *x, const double *y, long long n)
{
  double sum[4] = {0.0, 0.0, 0.0, 0.0};
  long long i = 0;
  for (; i + 4 <= n; i += 4)
    for (int k = 0; k < 4; k++)
      sum[k] += x[i + k] * y[i + k];
  for (; i < n; i++)
    sum[0] += x[i] * y[i];
  return (sum[0] + sum[1]) + (sum[2] + sum[3]);
}

/* Bound of the rounding error of scale G x, per constraint. */
static void compute_rounding(const constraint_system *held, const double *derivative, const double *x, double scale)
{
  for (long long k = 0; k < held->count; k++) {
    double terms = 0.0;
    for (int e = held->of.first[k]; e < held->of.first[k + 1]; e++)
      terms += fabs(derivative[e] * x[held->of.place[e]]);
    held->rounding[k] = DBL_EPSILON * fabs(scale) * terms;
  }
}

/* Returns 1 if some residual exceeds its rounding error. */
static int exceeds_rounding(const constraint_system *held)
{
  int found = 0;
  for (long long k = 0; k < held->count; k++)
    found |= !(fabs(held->right[k]) <= held->rounding[k]);
  return found;
}

/* change += step way, right -= step image; returns the squared norm of the residual. */
static double move_on(const constraint_system *held, double step)
{
  for (long long k = 0; k < held->count; k++) {
    held->change[k] += step * held->direction[k];
    held->right[k] -= step * held->image[k];
  }
  return product_of(held->right, held->right, held->count);
}

/* Solves (G M^-1 G^T) change = right to the relative tolerance or to rounding. Returns OK, NOT_CONVERGED, SINGULAR or
 * NOT_FINITE. */
static int solve_constraint_system(const constraint_system *held, double tolerance, solver_report *report)
{
  const long long n = held->count;
  if (held->is_exact) {
    precondition(held, held->right, held->change);
    return OK;
  }
  double size = product_of(held->right, held->right, n), derivative;
  double length; /* squared, of the search direction in the metric of L D L^T */
  const double least = tolerance * tolerance * size;
  memset(held->change, 0, sizeof(double) * (size_t)n);
  TRY(size < INFINITY ? OK : NOT_FINITE);
  precondition(held, held->right, held->preconditioned);
  memcpy(held->direction, held->preconditioned, sizeof(double) * (size_t)n);
  length = derivative = product_of(held->right, held->preconditioned, n);
  for (long long k = 0; size > least && exceeds_rounding(held); k++) {
    double curve, again, last = derivative;
    if (k >= n + SPARE_PRODUCTS)
      return NOT_CONVERGED;
    multiply(held, held->direction, held->image);
    report->products++;
    curve = product_of(held->direction, held->image, n);
    TRY(curve > DEPENDENT * length ? OK : SINGULAR);
    size = move_on(held, derivative / curve);
    precondition(held, held->right, held->preconditioned);
    derivative = product_of(held->right, held->preconditioned, n);
    again = derivative / last;
    length = derivative + again * again * length; /* the residual is orthogonal to the direction */
    for (long long i = 0; i < n; i++)
      held->direction[i] = held->preconditioned[i] + again * held->direction[i];
  }
  return OK;
}
