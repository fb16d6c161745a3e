#include "../core/step.h"
#include "../newton/band.h"
#include "../newton/stages.h"

/* Linear maps between tangent vectors of the inputs of a step, of its unknowns, of the arguments and results of kernels
 * at points, and of the rows of its equations; and their transposes. Requires: real, M, B, STEP_INPUTS, WIDTH, band.h,
 * stages.h; if DAMPED, damping.h. */

#ifdef DAMPED
#define GROWN(weight, growth, abscissa) ((weight) * MATH(exp)((growth) * (abscissa)))
#else
#define GROWN(weight, growth, abscissa) ((void)(growth), (weight))
#endif

/* WIDTH vectors at a time. */
typedef struct {
  real lane[WIDTH];
} wide;

/* y += factor x; back: the transpose, x += factor y. */
static inline void propagate(int back, wide *y, real factor, wide *x)
{
  real *restrict to = back ? x->lane : y->lane;
  const real *restrict from = back ? y->lane : x->lane;
  for (int j = 0; j < WIDTH; j++)
    to[j] += factor * from[j];
}

/* Sums from unknowns to points, or from points to rows, at points from `offset` on: for `sites` sites from the first,
 * times h^power. */
typedef struct {
  const real *table;
  int first, sites, offset, power, from_state;
} linear_loop;

/* Derivatives from number `first` on: of the result at offset `to` with respect to the argument at offset `from`. */
typedef struct {
  const int (*pair)[2];
  int count, first, to, from;
} derivative_block;

typedef void derivative_kernel(const real *u, real t, const real *parameters, real *value, real *derivative);
typedef void value_kernel(const real *u, real t, const real *parameters, real *value);

/* Stage group: points with the same kernel. Numbers of points, arguments, results and derivatives; sources of arguments
 * and destinations of results; the kernel with derivatives with respect to the arguments, and `by_given`, with respect
 * to parameters and time: {i, j}, j from the first parameter on; second derivatives, if results are not linear and they
 * are requested. */
typedef struct {
  int points, arguments, results, partials, given, gathers, scatters, blocks;
  const linear_loop *gather, *scatter;
  const derivative_block *block;
  const real *weight, *abscissa;
  derivative_kernel *kernel;
  value_kernel *by_given;
  const int (*input_pair)[2];
  value_kernel *curvature;
} stage_group;

static real power_of(real h, int k)
{
  real product = 1;
  for (int i = 0; i < (k < 0 ? -k : k); i++)
    product *= h;
  return k < 0 ? 1 / product : product;
}

/* Arguments at each point. */
static void arguments_of(const stage_group *f, const step_data *step, const real *z, real *at)
{
  for (int g = 0; g < f->gathers; g++) {
    const linear_loop *loop = f->gather + g;
    const real scale = power_of(step->h, loop->power);
    gather(loop->table, f->points, scale, z + loop->first * B, loop->sites, at + loop->offset, f->arguments, 1);
    if (loop->from_state)
      offset(step, f->points, at + loop->offset, f->arguments);
  }
}

static real time_of(const stage_group *f, const step_data *step, int n)
{
  return step->t + (f->abscissa ? f->abscissa[n] * step->h : 0);
}

/* End of the derivatives of a stage group; if DAMPED, those with respect to gamma h follow those with respect to
 * inputs. */
static inline long long end_of_derivatives(const stage_group *f)
{
  const long long each = f->arguments + f->results + f->partials + f->given;
#ifdef DAMPED
  return f->points * (each + f->results);
#else
  return f->points * each;
#endif
}

/* Computes at each point, with fixed unknowns: derivatives with respect to h of the arguments and of the factors of the
 * results; of the results with respect to the arguments; to parameters and time; to gamma h. Returns their end. */
static real *derivatives_of_group(const stage_group *f, const step_data *step, const real *z, real *by_h)
{
  const real h = step->h;
  real *value = by_h + f->points * f->arguments, *derivative = value + f->points * f->results;
  real *given = derivative + f->points * f->partials;
  arguments_of(f, step, z, by_h);
  for (int n = 0; n < f->points; n++) {
    const real t = time_of(f, step, n), *u = by_h + n * f->arguments;
    f->kernel(u, t, step->parameters, value + n * f->results, derivative + n * f->partials);
    if (f->given)
      f->by_given(u, t, step->parameters, given + n * f->given);
  }
#ifdef DAMPED
  for (int n = 0; n < f->points; n++)
    for (int i = 0; i < f->results; i++)
      given[f->points * f->given + n * f->results + i] = f->abscissa[n] * value[n * f->results + i];
#endif
  for (int g = 0; g < f->gathers; g++) {
    const linear_loop *loop = f->gather + g;
    const real scale = (real)loop->power * power_of(h, loop->power - 1);
    gather(loop->table, f->points, scale, z + loop->first * B, loop->sites, by_h + loop->offset, f->arguments, 1);
  }
  for (int s = 0; s < f->scatters; s++)
    for (int n = 0; n < f->points; n++)
      for (int i = 0; i < f->scatter[s].sites; i++)
        value[n * f->results + f->scatter[s].offset + i] *= (real)f->scatter[s].power / h;
  return by_h + end_of_derivatives(f);
}

/* From unknowns to arguments. */
static void gather_wide(const stage_group *f, real h, int back, wide *dz, wide *u)
{
  for (int g = 0; g < f->gathers; g++) {
    const linear_loop *loop = f->gather + g;
    const real scale = power_of(h, loop->power);
    for (int i = 0; i < loop->sites; i++)
      for (int b = 0; b < B; b++)
        for (int n = 0; n < f->points; n++)
          propagate(back, u + n * f->arguments + loop->offset + i, scale * loop->table[b * f->points + n],
              dz + (loop->first + i) * B + b);
  }
}

/* From q0 and h to arguments. */
static void start_wide(const stage_group *f, int back, const real *by_h, wide *v, wide *u)
{
  for (int g = 0; g < f->gathers; g++)
    for (int n = 0; f->gather[g].from_state && n < f->points; n++)
      for (int i = 0; i < M; i++)
        propagate(back, u + n * f->arguments + f->gather[g].offset + i, 1, v + i);
  for (int i = 0; i < f->points * f->arguments; i++)
    propagate(back, u + i, by_h[i], v + INPUT_H);
}

/* From parameters, t and h to results. */
static void inputs_wide(const stage_group *f, int back, const real *by_h, const real *given, wide *v, wide *value)
{
  for (int n = 0; n < f->points; n++)
    for (int e = 0; e < f->given; e++) {
      wide *result = value + n * f->results + f->input_pair[e][0], *from = v + 2 * M + f->input_pair[e][1];
      propagate(back, result, given[n * f->given + e], from);
      if (from == v + INPUT_H - 1)
        propagate(back, result, given[n * f->given + e] * f->abscissa[n], v + INPUT_H);
    }
  for (int i = 0; i < f->points * f->results; i++)
    propagate(back, value + i, by_h[i], v + INPUT_H);
}

/* From arguments to results. */
static void multiply_wide(const stage_group *f, int back, const real *derivative, wide *u, wide *value)
{
  for (int k = 0; k < f->blocks; k++)
    for (int n = 0; n < f->points; n++)
      for (int e = 0; e < f->block[k].count; e++)
        propagate(back, value + n * f->results + f->block[k].to + f->block[k].pair[e][0],
            derivative[n * f->partials + f->block[k].first + e],
            u + n * f->arguments + f->block[k].from + f->block[k].pair[e][1]);
}

/* From results to rows, from row `first` of each site on. */
static void scatter_wide(const stage_group *f, real h, real growth, int back, int first, wide *value, wide *rows)
{
  for (int s = 0; s < f->scatters; s++) {
    const linear_loop *loop = f->scatter + s;
    const real scale = power_of(h, loop->power);
    for (int i = 0; i < loop->sites; i++)
      for (int n = 0; n < f->points; n++)
        for (int r = first; r <= B; r++)
          propagate(back, rows + (loop->first + i) * (B + 1) + r,
              GROWN(f->weight[n], growth, f->abscissa[n]) * scale * loop->table[n * (B + 1) + r],
              value + n * f->results + loop->offset + i);
  }
}

/* From v and dz, where they are not NULL, to arguments. */
static void arguments_wide(const stage_group *f, real h, int back, const real *by_h, wide *v, wide *dz, wide *u)
{
  if (v)
    start_wide(f, back, by_h, v, u);
  if (dz)
    gather_wide(f, h, back, dz, u);
}

/* Step data besides the derivatives: h; if DAMPED, gamma h and its variations. */
typedef struct {
  real h, growth;
  wide *grown;
} step_change;

/* From v to all rows, or from dz to the last ones, through the points of a stage group; back: the transpose. Returns
 * the end of its derivatives. */
static const real *through_group(const stage_group *f, const step_change *by, int back, const real *partials,
    wide *points, wide *v, wide *dz, wide *rows)
{
  const real h = by->h;
  const real *by_h = partials + f->points * f->arguments, *derivative = by_h + f->points * f->results;
  const real *given = derivative + f->points * f->partials;
  wide *value = points + f->points * f->arguments;
  memset(points, 0, sizeof(wide) * (size_t)(f->points * (f->arguments + f->results)));
  if (back)
    scatter_wide(f, h, by->growth, back, v ? 0 : B, value, rows);
  else
    arguments_wide(f, h, back, partials, v, dz, points);
  multiply_wide(f, back, derivative, points, value);
  if (v)
    inputs_wide(f, back, by_h, given, v, value);
  for (int i = 0; v && by->grown && i < f->points * f->results; i++)
    propagate(back, value + i, given[f->points * f->given + i], by->grown);
  if (back)
    arguments_wide(f, h, back, partials, v, dz, points);
  else
    scatter_wide(f, h, by->growth, back, v ? 0 : B, value, rows);
  return partials + end_of_derivatives(f);
}

static void swap_wide(wide *a, wide *b)
{
  const wide kept = *a;
  *a = *b;
  *b = kept;
}

/* Subtracts multiples of row k in the forward substitution with the factors, or its transpose; see back_substitute. */
static void lower_wide(const real *a, const band *shape, const real *pivot, int k, int back, wide *x)
{
  const real *column = a + shape->first + k * shape->stride;
  if (!back)
    swap_wide(x + k, x + (int)pivot[k]);
  for (int i = k + 1; i < least(k + shape->reach + 1, shape->rows); i++)
    propagate(back, x + i, -column[i], x + k);
  if (back)
    swap_wide(x + k, x + (int)pivot[k]);
}

/* Eliminates unknown k in the back substitution, or its transpose. */
static void upper_wide(const real *a, const band *shape, int k, int back, wide *x)
{
  const real *column = a + shape->first + k * shape->stride;
  for (int j = 0; !back && j < WIDTH; j++)
    x[k].lane[j] *= column[k];
  for (int i = most(k - 2 * shape->reach, 0); i < k; i++)
    propagate(back, x + i, -column[i], x + k);
  for (int j = 0; back && j < WIDTH; j++)
    x[k].lane[j] *= column[k];
}

/* x = a^-1 x with the factors of a; back: with the transpose of a. */
static void solve_wide(const real *a, const band *shape, const real *pivot, int back, wide *x)
{
  for (int k = 0; k < shape->rows; k++)
    if (back)
      upper_wide(a, shape, k, back, x);
    else
      lower_wide(a, shape, pivot, k, back, x);
  for (int k = shape->rows - 1; k >= 0; k--)
    if (back)
      lower_wide(a, shape, pivot, k, back, x);
    else
      upper_wide(a, shape, k, back, x);
}
