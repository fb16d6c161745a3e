#include "../newton/band.h"

/* The contact problem: forces f in the product K of the friction cones of contacts, with rates
 *
 *   u = b + W f,   u + mu |u_t| n in K*,   f . (u + mu |u_t| n) = 0
 *
 * (G. de Saxce, C. R. Acad. Sci. 314, 1992; V. Acary & B. Brogliato, Numerical Methods for Nonsmooth Dynamical Systems,
 * 2008): normal forces and rates are not negative, one of them is 0, and friction of at most mu f_n opposes the slip,
 * with mu f_n where that is not 0. Without gap the limit is a given size instead of mu f_n. Second rates b pose forces,
 * rates b impulses, and rates + h second rates those of a step of length h, for which a solution exists for every b and
 * mu if W > 0. Within fewer proximal points the last one is the solution with a compliance R: u = b + (W + R) f up to
 * the change of f by it. Requires: EVENT_CONTACTS, CONTACT_ROWS: the largest numbers; CONTACTS. */
enum {
  CONE_NEWTON = 12, /* steps of Newton's method */
  CONE_POINTS = 250 /* proximal points */
};

#define CONE_EXACT 1e-12 /* residual relative to 1 + |f|, where W_kk = 1 and b is at most 1 */
/* First weight of the distance from a proximal point, and its inverse the largest. In 3,000 random redundant problems
 * factors .3 after a solution and 30 otherwise solved all, .1 and 30 all but one. */
#define CONE_NEAR 1e-6
#define CONE_DEPENDENT 1e-13 /* pivots below which rows depend: of their forces the nearest ones are found */
#define CONTACT_ROUNDING 1e-10 /* part of their size below which gaps, rates and forces count as 0 */

/* What a contact does by its rates: closed with a rate 0 of its gap, and whether it pushes; sticks with a rate 0 of its
 * slip, else that has a direction. */
typedef struct {
  int is_closed, pushes, sticks;
  real direction[2];
} cone_mode;

/* A problem of contacts by their places in its rows, and its solution. Contacts that take part have friction of
 * coefficient mu, until they slip mu_static if `rests`, or limits of that size without a gap. The part |given| of
 * sliding friction is against `given`: all of it of a slip that has that direction. terms: sizes of the terms of b, by
 * whose rounding it differs from 0. Newton's method starts from f. */
typedef struct {
  const contact_places *places;
  int contacts, rows;
  const real *W; /* CONTACT_ROWS apart */
  real b[CONTACT_ROWS], terms[CONTACT_ROWS], f[CONTACT_ROWS];
  int takes_part[EVENT_CONTACTS], rests[EVENT_CONTACTS];
  real mu[EVENT_CONTACTS], mu_static[EVENT_CONTACTS], given[EVENT_CONTACTS][2];
  cone_mode mode[EVENT_CONTACTS];
  int is_static[EVENT_CONTACTS]; /* whether mu_static is the limit of friction in the solution */
  int most_points; /* proximal points of a block */
  int newtons, points; /* counts of the solution */
  real compliance, residual; /* largest of the blocks where W_kk = 1: weight of the last point, residual / (1 + |f|) */
} cone_problem;

/* Unknowns of a contact in a block: x_n (-1: none), first of its friction that is not given, their number, and the
 * radius of their disc, mu x_n or without a gap mu. */
typedef struct {
  int contact, normal, slip, slips;
  real mu;
} cone_part;

/* Contacts that W connects, with W_kk = 1 for each contact, normal and friction apart, and terms of b of at most 1:
 * rates b + A x of unknowns x, by columns, A with given friction in the columns of normal forces; scales of rows. */
typedef struct {
  int count, parts, row[CONTACT_ROWS];
  cone_part part[EVENT_CONTACTS];
  int is_loaded; /* whether any terms act: without forces contacts are open */
  real scale[CONTACT_ROWS], size, b[CONTACT_ROWS], A[CONTACT_ROWS * CONTACT_ROWS];
  real weight, near[CONTACT_ROWS]; /* of the distance from a proximal point */
  real J[CONTACT_ROWS * CONTACT_ROWS];
} cone_block;

static real length_of(const real *x, int count)
{
  return count == 0 ? 0.0 : count == 1 ? fabs(x[0])
                                       : hypot(x[0], x[1]);
}

/* Lists the rows of a contact and returns their number. */
static int rows_of(const contact_places *at, int *row)
{
  int count = 0;
  if (at->normal >= 0)
    row[count++] = at->normal;
  for (int i = 0; i < at->slips; i++)
    row[count++] = at->tangential + i;
  return count;
}

static real cone_rate(const cone_problem *in, int row)
{
  real rate = in->b[row];
  for (int j = 0; j < in->rows; j++)
    rate += in->f[j] == 0.0 ? 0.0 : in->W[row * CONTACT_ROWS + j] * in->f[j]; /* rows of others may be undefined */
  return rate;
}

/* z = x - u of all unknowns, near a proximal point divided by 1 + weight. */
static void cone_unprojected(const cone_block *of, const real *x, real *z)
{
  const real all = 1.0 + of->weight;
  for (int i = 0; i < of->count; i++)
    z[i] = x[i] - (of->b[i] + of->weight * (x[i] - of->near[i])) / all;
  for (int j = 0; j < of->count; j++)
    for (int i = 0; i < of->count; i++)
      z[i] -= of->A[j * of->count + i] / all * x[j];
}

/* Subtracts a part of the derivatives of z_i from those of residual r. */
static void cone_derivative(cone_block *of, int r, int i, real part)
{
  const int n = of->count;
  if (part == 0.0)
    return;
  for (int j = 0; j < n; j++)
    of->J[j * n + r] += part / (1.0 + of->weight) * of->A[j * n + i];
  of->J[i * n + r] -= part / (1.0 + of->weight);
}

/* Residuals r of x_n = max(z_n, 0) and x_t = projection of z_t onto the disc of radius mu max(z_n, 0), and with `J`
 * their generalised derivatives by columns (P. Alart & A. Curnier, Comput. Methods Appl. Mech. Eng. 92, 1991). Returns
 * the largest one. */
static real cone_residuals(cone_block *of, const real *x, int derivatives, real *r)
{
  const int n = of->count;
  real z[CONTACT_ROWS];
  cone_unprojected(of, x, z);
  memcpy(r, x, sizeof(real) * (size_t)n);
  if (derivatives)
    memset(of->J, 0, sizeof(real) * (size_t)(n * n));
  for (int i = 0; i < n && derivatives; i++)
    of->J[i * n + i] = 1.0;
  for (int k = 0; k < of->parts; k++) {
    const cone_part *const at = of->part + k;
    const int pushes = at->normal < 0 || z[at->normal] > 0.0;
    const real radius = !pushes ? 0.0 : at->normal < 0 ? at->mu
                                                       : at->mu * z[at->normal];
    real z_t[2] = {0.0};
    memcpy(z_t, z + at->slip, sizeof(real) * (size_t)at->slips);
    const real length = length_of(z_t, 2);
    const int sticks = radius > 0.0 && length <= radius;
    const real across = sticks ? 1.0 : radius / fmax(length, DBL_MIN);
    if (at->normal >= 0 && pushes) {
      r[at->normal] -= z[at->normal];
      if (derivatives)
        cone_derivative(of, at->normal, at->normal, 1.0);
    }
    for (int i = 0; i < at->slips; i++) {
      const real direction = z_t[i] / fmax(length, DBL_MIN);
      r[at->slip + i] -= across * z_t[i];
      for (int l = 0; l < at->slips && derivatives; l++) {
        const real turn = sticks ? 0.0 : direction * z_t[l] / fmax(length, DBL_MIN);
        cone_derivative(of, at->slip + i, at->slip + l, across * ((i == l) - turn));
      }
      if (derivatives && pushes && !sticks && at->normal >= 0)
        cone_derivative(of, at->slip + i, at->normal, at->mu * direction);
    }
  }
  return largest_magnitude(r, n);
}

static int is_exact(const cone_block *of, const real *x, real residual)
{
  return residual <= CONE_EXACT * (1.0 + largest_magnitude(x, of->count));
}

/* Newton's method from x, without a line search; 0 where rows depend on each other. */
static int cone_newton(cone_problem *in, cone_block *of, real *x)
{
  const band shape = band_within(of->count, of->count);
  real r[CONTACT_ROWS], pivot[CONTACT_ROWS];
  for (int steps = 0; !is_exact(of, x, cone_residuals(of, x, 1, r)); steps++) {
    if (steps == CONE_NEWTON || !factorise(of->J, &shape, pivot))
      return 0;
    for (int i = 0; i < of->count; i++) /* inverses of the pivots */
      if (!(fabs(of->J[i * (of->count + 1)]) * CONE_DEPENDENT < 1.0))
        return 0;
    back_substitute(of->J, &shape, pivot, r);
    for (int i = 0; i < of->count; i++)
      x[i] -= r[i];
    in->newtons++;
  }
  return 1;
}

/* Proximal points (R. T. Rockafellar, SIAM J. Control Optim. 14, 1976): the weight of the distance from the last one
 * makes the equations of redundant contacts regular; it decreases with solutions. */
static int cone_points(cone_problem *in, cone_block *of, real *x)
{
  real next[CONTACT_ROWS], r[CONTACT_ROWS], weight = CONE_NEAR, last = 0.0;
  for (int point = 0; point < in->most_points && weight * CONE_NEAR < 1.0; point++) {
    in->points++;
    of->weight = weight;
    memcpy(of->near, x, sizeof r);
    memcpy(next, x, sizeof r);
    const int solved = cone_newton(in, of, next);
    of->weight = 0.0;
    if (!solved) {
      weight *= 30.0;
      continue;
    }
    memcpy(x, next, sizeof r);
    if (is_exact(of, x, cone_residuals(of, x, 0, r)))
      return 1;
    last = weight;
    weight = fmax(DBL_EPSILON, 0.3 * weight);
  }
  in->compliance = fmax(in->compliance, last);
  return in->most_points < CONE_POINTS && last > 0.0;
}

static real cone_limit(const cone_problem *in, int k)
{
  return in->is_static[k] ? in->mu_static[k] : in->mu[k];
}

/* Adds a row as an unknown, with a scale. */
static int cone_unknown(cone_block *of, int row, real scale)
{
  of->row[of->count] = row;
  of->scale[of->count] = scale;
  return of->count++;
}

/* Unknowns of a contact. */
static void cone_part_of(const cone_problem *in, int k, cone_block *of)
{
  const contact_places *const at = in->places + k;
  cone_part *const part = of->part + of->parts++;
  real trace = 0.0;
  const real free = fmax(1.0 - length_of(in->given[k], at->slips), 0.0), limit = free * cone_limit(in, k);
  for (int i = 0; i < at->slips; i++)
    trace += in->W[(at->tangential + i) * (CONTACT_ROWS + 1)] / at->slips;
  const real diagonal = at->normal < 0 ? 1.0 : in->W[at->normal * (CONTACT_ROWS + 1)];
  const real across = trace > 0.0 ? 1.0 / sqrt(trace) : 1.0, along = diagonal > 0.0 ? 1.0 / sqrt(diagonal) : 1.0;
  *part = (cone_part){.contact = k, .normal = -1, .slip = of->count, .mu = limit / across};
  if (at->normal >= 0) {
    part->normal = cone_unknown(of, at->normal, along);
    part->mu *= along;
  }
  part->slip = of->count;
  part->slips = free > CONTACT_ROUNDING ? at->slips : 0;
  for (int i = 0; i < part->slips; i++)
    cone_unknown(of, at->tangential + i, across);
}

/* Marks the contacts that take part and whose forces W connects with those of `first`. */
static void cone_connect(const contact_places *places, int contacts, const real *W, const int *takes_part, int first,
    int *member)
{
  int list[EVENT_CONTACTS] = {first}, count = 1;
  member[first] = 1;
  for (int i = 0; i < count; i++)
    for (int k = 0; k < contacts; k++) {
      int row[3], column[3], meets = 0;
      if (!takes_part[k] || member[k])
        continue;
      const int rows = rows_of(places + list[i], row), columns = rows_of(places + k, column);
      for (int r = 0; r < rows; r++)
        for (int c = 0; c < columns; c++)
          meets |= W[row[r] * CONTACT_ROWS + column[c]] != 0.0;
      if (meets) {
        member[k] = 1;
        list[count++] = k;
      }
    }
}

/* Equations of the contacts of a block, and the unknowns x of the present forces. */
static void cone_gather(cone_problem *in, const int *member, cone_block *of, real *x)
{
  real start[CONTACT_ROWS];
  of->count = of->parts = 0;
  of->weight = of->size = 0.0;
  memset(of->near, 0, sizeof of->near);
  for (int k = 0; k < in->contacts; k++)
    if (member[k])
      cone_part_of(in, k, of);
  memcpy(start, in->f, sizeof start);
  for (int k = 0; k < of->parts; k++) { /* rates without unknown forces */
    const int contact = of->part[k].contact;
    const contact_places *const at = in->places + contact;
    if (at->normal >= 0)
      in->f[at->normal] = 0.0;
    for (int i = 0; i < at->slips; i++) {
      const real part = -cone_limit(in, contact) * in->given[contact][i];
      in->f[at->tangential + i] = at->normal < 0 ? part : 0.0;
      start[at->tangential + i] -= part * (at->normal < 0 ? 1.0 : start[at->normal]);
    }
  }
  for (int i = 0; i < of->count; i++) {
    of->b[i] = of->scale[i] * cone_rate(in, of->row[i]);
    of->size = fmax(of->size, fmax(fabs(of->b[i]), of->scale[i] * in->terms[of->row[i]]));
  }
  of->is_loaded = of->size > 0.0;
  of->size = of->is_loaded ? of->size : 1.0;
  for (int i = 0; i < of->count; i++) {
    of->b[i] /= of->size;
    x[i] = start[of->row[i]] / of->scale[i] / of->size;
    for (int j = 0; j < of->count; j++)
      of->A[j * of->count + i] = of->scale[i] * in->W[of->row[i] * CONTACT_ROWS + of->row[j]] * of->scale[j];
  }
  for (int k = 0; k < of->parts; k++) {
    const cone_part *const part = of->part + k;
    const contact_places *const at = in->places + part->contact;
    const real limit = cone_limit(in, part->contact);
    of->part[k].mu /= part->normal < 0 ? of->size : 1.0;
    for (int l = 0; l < at->slips && part->normal >= 0; l++)
      for (int i = 0; i < of->count; i++)
        of->A[part->normal * of->count + i] -= limit * in->given[part->contact][l] * of->scale[part->normal] *
            of->scale[i] * in->W[of->row[i] * CONTACT_ROWS + at->tangential + l];
  }
}

/* Modes of the contacts of a block by the rates with its solution, whose friction has the direction -z_t. */
static void cone_modes(cone_problem *in, const cone_block *of, const real *x)
{
  real z[CONTACT_ROWS] = {0.0};
  const real small = CONTACT_ROUNDING * fmax(1.0, largest_magnitude(x, of->count));
  cone_unprojected(of, x, z);
  for (int k = 0; k < of->parts; k++) {
    const cone_part *const part = of->part + k;
    const int contact = part->contact, n = part->normal;
    cone_mode *const mode = in->mode + contact;
    real slip[2] = {0.0}, z_t[2] = {0.0};
    mode->is_closed = n < 0 || (of->is_loaded && fabs(x[n] - z[n]) <= small);
    mode->pushes = n < 0 || x[n] > small;
    memcpy(mode->direction, in->given[contact], sizeof mode->direction);
    for (int i = 0; i < part->slips; i++) {
      z_t[i] = z[part->slip + i];
      slip[i] = x[part->slip + i] - z_t[i];
    }
    for (int i = 0; i < part->slips; i++)
      mode->direction[i] = -z_t[i] / fmax(length_of(z_t, 2), DBL_MIN);
    mode->sticks = mode->is_closed && part->slips > 0 && length_of(slip, 2) <= small;
  }
}

/* Solves the problem of one block; its forces are 0 if there is no solution. */
static int cone_solve_block(cone_problem *in, const int *member, cone_block *of)
{
  real x[CONTACT_ROWS] = {0.0}, from[CONTACT_ROWS], r[CONTACT_ROWS];
  cone_gather(in, member, of, x);
  memcpy(from, x, sizeof x);
  int solved = cone_newton(in, of, x);
  if (!solved) {
    memcpy(x, from, sizeof x);
    solved = cone_points(in, of, x);
  }
  if (!solved)
    return 0;
  in->residual = fmax(in->residual, cone_residuals(of, x, 0, r) / (1.0 + largest_magnitude(x, of->count)));
  for (int i = 0; i < of->count; i++)
    in->f[of->row[i]] = x[i] * of->scale[i] * of->size;
  for (int k = 0; k < of->parts; k++) {
    const int contact = of->part[k].contact, normal = in->places[contact].normal;
    for (int i = 0; i < in->places[contact].slips && normal >= 0; i++)
      in->f[in->places[contact].tangential + i] -= cone_limit(in, contact) * in->given[contact][i] * in->f[normal];
    for (int i = 0; i < in->places[contact].slips && normal < 0 && of->part[k].slips > 0; i++)
      in->f[in->places[contact].tangential + i] -= cone_limit(in, contact) * in->given[contact][i];
  }
  cone_modes(in, of, x);
  return 1;
}

/* Scaled rate of a slip that is faster than others with the static limit, 0 if it has not this limit. */
static real cone_static_slip(const cone_problem *in, int k)
{
  const int slip = in->places[k].tangential, slips = in->places[k].slips;
  real rate[2] = {0.0}, trace = 0.0;
  if (!in->is_static[k] || in->mu_static[k] == in->mu[k] || in->mode[k].sticks || !in->mode[k].is_closed)
    return 0.0;
  for (int i = 0; i < slips; i++) {
    rate[i] = cone_rate(in, slip + i);
    trace += in->W[(slip + i) * (CONTACT_ROWS + 1)];
  }
  return length_of(rate, slips) / sqrt(fmax(trace, DBL_MIN));
}

/* First contact of a block with the fastest slip that has the static limit, -1: none. */
static int cone_fastest(const cone_problem *in, const int *member)
{
  real largest = 0.0;
  int fastest = -1;
  for (int k = 0; k < in->contacts; k++) {
    const real rate = member[k] ? cone_static_slip(in, k) : 0.0;
    fastest = rate > largest ? k : fastest;
    largest = fmax(largest, rate);
  }
  return fastest;
}

/* Solves a block by static limits at slips that rest; of those that slip the fastest one gets its sliding limit, until
 * none slips with a static limit; then each of these is tried with its static limit once more. */
static int cone_solve_static(cone_problem *in, const int *member, cone_block *of)
{
  int lowered[EVENT_CONTACTS] = {0}, fastest, solved = cone_solve_block(in, member, of);
  while (solved && (fastest = cone_fastest(in, member)) >= 0) {
    lowered[fastest] = 1;
    in->is_static[fastest] = 0;
    solved = cone_solve_block(in, member, of);
  }
  for (int k = 0; k < in->contacts && solved; k++) {
    if (!lowered[k] || in->mode[k].sticks)
      continue;
    const cone_problem before = *in;
    in->is_static[k] = 1;
    if (!cone_solve_block(in, member, of) || !in->mode[k].sticks || cone_fastest(in, member) >= 0)
      *in = before;
  }
  return solved;
}

/* Solves a problem within so many proximal points of a block; returns whether a solution was found, f, modes. */
static int solve_cone_within(cone_problem *in, int most_points)
{
  cone_block block;
  int done[EVENT_CONTACTS] = {0}, solved = 1;
  in->most_points = most_points;
  in->newtons = in->points = 0;
  in->compliance = in->residual = 0.0;
  for (int k = 0; k < in->contacts; k++) {
    int row[3];
    in->is_static[k] = in->rests[k];
    in->mode[k] = (cone_mode){0};
    for (int r = rows_of(in->places + k, row) - 1; r >= 0 && !in->takes_part[k]; r--)
      in->f[row[r]] = 0.0;
    done[k] = !in->takes_part[k];
  }
  for (int k = 0; k < in->contacts && solved; k++) {
    int member[EVENT_CONTACTS] = {0};
    if (done[k])
      continue;
    cone_connect(in->places, in->contacts, in->W, in->takes_part, k, member);
    solved = cone_solve_static(in, member, &block);
    for (int j = 0; j < in->contacts; j++)
      done[j] |= member[j];
  }
  return solved;
}

/* Solves a problem of the rows of CONTACTS. */
static int solve_cone(cone_problem *in)
{
  in->places = CONTACTS;
  in->contacts = EVENT_CONTACTS;
  in->rows = CONTACT_ROWS;
  return solve_cone_within(in, CONE_POINTS);
}
