#include "../constraints/constraints.h"
#include "pair_states.h"

/* Projection onto constraints, and Lagrange multipliers, in pairs: solutions in double, corrected with the factors of
 * the same matrices by residuals in pairs. Requires: the kernels constraints_pairs (g, then the derivatives),
 * constrained_motion_pairs and legendre_pairs (with the mass matrix). */

enum { PAIR_CORRECTIONS = 4,
  MOST_PAIR_CORRECTIONS = 16 };
#define SETTLED_PAIRS 1e-31 /* relative to the state: update after which there is no further one */

static double largest_high(const dd *x)
{
  double largest = 0.0;
  for (int i = 0; i < M; i++)
    largest = larger(largest, fabs(x[i].high));
  return largest;
}

static inline void high_words(const dd *x, int n, double *high)
{
  for (int i = 0; i < n; i++)
    high[i] = x[i].high;
}

/* Computes g, its rate G v + g_t and the velocity u + M of a state. */
static int constrained_pairs(dd t, const dd *q, const dd *p, const double *parameters, dd *u, dd *g, dd *rate,
    double *workspace)
{
  dd value[M + 2 * CONSTRAINTS];
  TRY(velocities_of(t, q, p, parameters, u + M, workspace));
  memcpy(u, q, sizeof(dd) * M);
  constraints_pairs(u, t, parameters, g);
  constrained_motion_pairs(u, t, parameters, value);
  memcpy(rate, value + M, sizeof(dd) * CONSTRAINTS);
  return OK;
}

int NAME(constraint_values)(long long count, const double *t, const double *q, const double *p,
    const double *parameters, double *g, double *rate, double *workspace)
{
  for (long long k = 0; k < count; k++) {
    dd positions[M], momenta[M], u[2 * M], values[CONSTRAINTS + CONSTRAINT_ENTRIES], rates[CONSTRAINTS];
    load_pairs(q + k * 2 * M, positions);
    load_pairs(p + k * 2 * M, momenta);
    TRY(constrained_pairs(dd_of(t[2 * k], t[2 * k + 1]), positions, momenta, parameters, u, values, rates, workspace));
    high_words(values, CONSTRAINTS, g + k * CONSTRAINTS);
    high_words(rates, CONSTRAINTS, rate + k * CONSTRAINTS);
    if (!all_finite(g + k * CONSTRAINTS, CONSTRAINTS) || !all_finite(rate + k * CONSTRAINTS, CONSTRAINTS))
      return NOT_FINITE;
  }
  return OK;
}

/* Sum of squares of g at positions in pairs; infinite if g is not finite. */
static double misfit_of_pairs(dd t, const dd *q, const double *parameters)
{
  double high[CONSTRAINTS], sum = 0.0;
  dd values[CONSTRAINTS + CONSTRAINT_ENTRIES];
  constraints_pairs(q, t, parameters, values);
  high_words(values, CONSTRAINTS, high);
  for (int j = 0; j < CONSTRAINTS; j++)
    sum += high[j] * high[j];
  return all_finite(high, CONSTRAINTS) ? sum : INFINITY;
}

/* Nearest state that satisfies the constraints: positions in double, then corrected; momenta p - G^T y. Positions that
 * satisfy the constraints better than those in double, of which rounding errors are 1e-16, are corrected themselves. */
int NAME(project)(const double *time, const double *q0, const double *p0, const double *parameters, double *q1,
    double *p1, double *workspace)
{
  saddle *at = saddle_in(workspace);
  const dd now = dd_of(time[0], time[1]);
  const double t = now.high;
  double high[2 * M], g[CONSTRAINTS], right[CONSTRAINTS], y[CONSTRAINTS], update[M], size = INFINITY;
  dd q[M], p[M], moved[M], u[2 * M], values[CONSTRAINTS + CONSTRAINT_ENTRIES], rate[CONSTRAINTS], sum[CONSTRAINTS];
  TRY(find_velocity(t, q0, p0, parameters, high + M, workspace));
  load_pairs(q0, q);
  memcpy(high, q0, sizeof(double) * M);
  TRY(project_position(t, high, parameters, at));
  for (int i = 0; i < M; i++)
    moved[i] = dd_add(q[i], dd_two_sum(high[i], -q0[i]));
  if (misfit_of_pairs(now, moved, parameters) < misfit_of_pairs(now, q, parameters))
    memcpy(q, moved, sizeof q);
  for (int k = 0; k < MOST_PAIR_CORRECTIONS && size > SETTLED_PAIRS * largest_high(q); k++) {
    high_words(q, M, high);
    TRY(factorise_saddle(IDEAL_FORCES, t, high, parameters, at, g));
    constraints_pairs(q, now, parameters, values);
    high_words(values, CONSTRAINTS, right);
    solve_saddle(at, NULL, right, update, y);
    for (int i = 0; i < M; i++)
      q[i] = dd_add(q[i], dd_word(update[i]));
    size = largest_of(update);
  }
  memset(sum, 0, sizeof sum);
  size = INFINITY;
  for (int k = 0; k < MOST_PAIR_CORRECTIONS && (k < 2 || size > SETTLED_PAIRS * largest_of(high + M)); k++) {
    load_pairs(p0, p);
    constraints_pairs(q, now, parameters, values);
    for (int e = 0; e < CONSTRAINT_ENTRIES; e++)
      p[CONSTRAINT_ENTRY[e][1]] = dd_subtract(p[CONSTRAINT_ENTRY[e][1]],
          dd_multiply(values[CONSTRAINTS + e], sum[CONSTRAINT_ENTRY[e][0]]));
    TRY(constrained_pairs(now, q, p, parameters, u, values, rate, workspace));
    high_words(u, 2 * M, high);
    TRY(factorise_saddle(IDEAL_FORCES, t, high, parameters, at, g));
    high_words(rate, CONSTRAINTS, right);
    solve_saddle(at, NULL, right, update, y);
    for (int j = 0; j < CONSTRAINTS; j++)
      sum[j] = dd_add(sum[j], dd_word(y[j]));
    size = largest_of(update);
  }
  TRY(store_pairs(q, q1));
  return store_pairs(p, p1);
}

static double product_of_vectors(const double *x, const double *y)
{
  double sum = 0.0;
  for (int i = 0; i < M; i++)
    sum += x[i] * y[i];
  return fabs(sum);
}

/* Relative size of a difference d with the dual e, of vectors whose larger squared norm is `size`. */
static double relative_size(const double *d, const double *e, double size)
{
  return size > 0.0 ? sqrt(product_of_vectors(d, e) / size) : 0.0;
}

/* Relative distances of two states: positions in the metric of the mass matrix, momenta in that of its inverse. */
int NAME(apart)(const double *time, const double *q0, const double *p0, const double *q1, const double *p1,
    const double *parameters, double *apart, double *workspace)
{
  const dd now = dd_of(time[0], time[1]);
  const double t = now.high;
  const double still[M] = {0};
  double u[2 * M], p[M], v[M], other[M], d[M], e[M], mass[MASS_ENTRIES];
  dd q[M], x[2][M], velocity[2][M];
  load_pairs(q1, q);
  for (int k = 0; k < 2; k++) {
    load_pairs(k ? p1 : p0, x[k]);
    TRY(velocities_of(now, q, x[k], parameters, velocity[k], workspace));
  }
  TRY(find_velocity(t, q1, still, parameters, p, workspace));
  for (int i = 0; i < M; i++) {
    d[i] = dd_subtract(x[1][i], x[0][i]).high;
    e[i] = dd_subtract(velocity[1][i], velocity[0][i]).high;
    v[i] = velocity[0][i].high - p[i];
    other[i] = velocity[1][i].high - p[i];
    u[i] = q1[i], u[M + i] = velocity[1][i].high;
  }
  apart[1] = relative_size(d, e, larger(product_of_vectors(p0, v), product_of_vectors(p1, other)));
  legendre(u, t, parameters, p, mass);
  for (int i = 0; i < M; i++)
    d[i] = dd_subtract(dd_of(q1[i], q1[M + i]), dd_of(q0[i], q0[M + i])).high;
  times_mass(mass, d, e);
  times_mass(mass, q0, v);
  times_mass(mass, q1, other);
  apart[0] = relative_size(d, e,
      larger(larger(product_of_vectors(q0, v), product_of_vectors(q1, other)),
          square_by_constraints(t, q1, parameters, mass, saddle_in(workspace))));
  return all_finite(apart, 2) ? OK : NOT_FINITE;
}

/* Lagrange multipliers as in constraints.h, high words, then low words, of each state. */
int NAME(multipliers)(long long count, const double *t, const double *q, const double *p, const double *parameters,
    double *multiplier, double *workspace)
{
  saddle *at = saddle_in(workspace);
  for (long long k = 0; k < count; k++) {
    const dd then = dd_of(t[2 * k], t[2 * k + 1]);
    dd positions[M], momenta[M], u[2 * M], g[CONSTRAINTS + CONSTRAINT_ENTRIES], rate[CONSTRAINTS];
    dd value[M + 2 * CONSTRAINTS], mass[M + MASS_ENTRIES], a[M], y[CONSTRAINTS];
    double high[2 * M], none[CONSTRAINTS], *to = multiplier + k * 2 * CONSTRAINTS;
    load_pairs(q + k * 2 * M, positions);
    load_pairs(p + k * 2 * M, momenta);
    TRY(constrained_pairs(then, positions, momenta, parameters, u, g, rate, workspace));
    high_words(u, 2 * M, high);
    TRY(factorise_saddle(IDEAL_FORCES, t[2 * k], high, parameters, at, none));
    memset(a, 0, sizeof a);
    memset(y, 0, sizeof y);
    legendre_pairs(u, then, parameters, mass);
    for (int n = 0; n < PAIR_CORRECTIONS; n++) {
      double forces[M], rates[CONSTRAINTS], change[M], change_of_y[CONSTRAINTS];
      constrained_motion_pairs(u, then, parameters, value); /* residuals: F - L_vv a - G^T y, -(rest) - G a */
      for (int e = 0; e < MASS_ENTRIES; e++)
        value[MASS_ENTRY[e][0]] = dd_subtract(value[MASS_ENTRY[e][0]], dd_multiply(mass[M + e], a[MASS_ENTRY[e][1]]));
      for (int e = 0; e < CONSTRAINT_ENTRIES; e++) {
        const int row = CONSTRAINT_ENTRY[e][0], i = CONSTRAINT_ENTRY[e][1], j = M + CONSTRAINTS + row;
        value[i] = dd_subtract(value[i], dd_multiply(g[CONSTRAINTS + e], y[row]));
        value[j] = dd_add(value[j], dd_multiply(g[CONSTRAINTS + e], a[i]));
      }
      high_words(value, M, forces);
      high_words(value + M + CONSTRAINTS, CONSTRAINTS, rates);
      solve_saddle(at, forces, rates, change, change_of_y);
      for (int i = 0; i < M; i++)
        a[i] = dd_add(a[i], dd_word(change[i]));
      for (int j = 0; j < CONSTRAINTS; j++)
        y[j] = dd_add(y[j], dd_word(change_of_y[j]));
    }
    for (int j = 0; j < CONSTRAINTS; j++)
      to[j] = -y[j].high, to[CONSTRAINTS + j] = -y[j].low;
    TRY(all_finite(to, 2 * CONSTRAINTS) ? OK : NOT_FINITE);
  }
  return OK;
}
