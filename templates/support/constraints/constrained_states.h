#include "../mechanics/energies.h"
#include "constraints.h"

/* States on constraints: values and rates, projection, distances, Lagrange multipliers. In pairs, solutions in double
 * are corrected with the factors of their matrices by residuals in pairs. Requires: the kernels constraints,
 * constrained_motion and legendre (with the mass matrix). */
#ifdef DOUBLE_DOUBLE
enum { REFINEMENTS = 4,
  MOST_REFINED_POSITIONS = 16 };
#define SETTLED_MOMENTUM 1e-31 /* update of the velocity, relative to it, after which there is no further one */
#else
enum { REFINEMENTS = 1 };
#define SETTLED_MOMENTUM SETTLED_UPDATE
#endif

static inline void high_words(const scalar *x, int n, real *high)
{
  for (int i = 0; i < n; i++)
    high[i] = HIGH_WORD(x[i]);
}

/* Computes g with its derivatives, its rate G v + g_t, and u = (q, v) of a state. */
static int constrained(scalar t, const scalar *q, const scalar *p, const real *parameters, scalar *u, scalar *g,
    scalar *rate, real *workspace)
{
  scalar value[M + 2 * CONSTRAINTS];
  real high[2 * CONSTRAINTS];
  TRY(velocities_of(t, q, p, parameters, u + M, workspace));
  memcpy(u, q, sizeof(scalar) * M);
  KERNEL_OF(constraints)(u, t, parameters, AND_DERIVATIVES(g, CONSTRAINTS));
  KERNEL_OF(constrained_motion)(u, t, parameters, value);
  memcpy(rate, value + M, sizeof(scalar) * CONSTRAINTS);
  high_words(g, CONSTRAINTS, high);
  high_words(rate, CONSTRAINTS, high + CONSTRAINTS);
  return all_finite(high, 2 * CONSTRAINTS) ? OK : NOT_FINITE;
}

int NAME(constraint_values)(long long count, const real *t, const real *q, const real *p, const real *parameters,
    real *g, real *rate, real *workspace)
{
  scalar x[M], y[M], u[2 * M], values[CONSTRAINTS + CONSTRAINT_ENTRIES], rates[CONSTRAINTS];
  for (long long k = 0; k < count; k++) {
    load_scalars(q + k * WORDS * M, x);
    load_scalars(p + k * WORDS * M, y);
    TRY(constrained(TIME_AT(t, k), x, y, parameters, u, values, rates, workspace));
    high_words(values, CONSTRAINTS, g + k * CONSTRAINTS);
    high_words(rates, CONSTRAINTS, rate + k * CONSTRAINTS);
  }
  return OK;
}

#ifdef DOUBLE_DOUBLE
/* Computes g and its derivatives; returns the sum of the squares of g, infinite if that is not finite. */
static real misfit_at(scalar t, const scalar *q, const real *parameters, scalar *values, real *g)
{
  real sum = 0;
  constraints_pairs(q, t, parameters, values);
  high_words(values, CONSTRAINTS, g);
  for (int j = 0; j < CONSTRAINTS; j++)
    sum += g[j] * g[j];
  return sum < INFINITY ? sum : (real)INFINITY;
}

/* Corrects positions q near those in u, which satisfy g = 0 in double, where rounding errors are 1e-16. Those that
 * satisfy it better are corrected themselves. */
static int finish_position(scalar t, real *u, const real *parameters, saddle *at, scalar *q)
{
  scalar moved[M], values[CONSTRAINTS + CONSTRAINT_ENTRIES];
  real g[CONSTRAINTS], y[CONSTRAINTS], update[M], size = INFINITY;
  for (int i = 0; i < M; i++)
    moved[i] = ADD(q[i], dd_two_sum(u[i], -HIGH_WORD(q[i])));
  if (misfit_at(t, moved, parameters, values, g) < misfit_at(t, q, parameters, values, g))
    memcpy(q, moved, sizeof moved);
  for (int k = 0; k < MOST_REFINED_POSITIONS && size > SETTLED_MOMENTUM * largest_magnitude(u, M); k++) {
    high_words(q, M, u);
    TRY(factorise_saddle(IDEAL_FORCES, HIGH_WORD(t), u, parameters, at, g));
    misfit_at(t, q, parameters, values, g);
    solve_saddle(at, NULL, g, update, y);
    for (int i = 0; i < M; i++)
      q[i] = ADD(q[i], SCALAR(update[i]));
    size = largest_magnitude(update, M);
  }
  return OK;
}

/* Subtracts L_vv a - G^T y from forces, and adds G a to the remaining terms of the second derivative of g. */
static void subtract_solution(scalar t, const scalar *u, const real *parameters, const scalar *a, const scalar *y,
    scalar *value)
{
  scalar mass[M + MASS_ENTRIES], g[CONSTRAINTS + CONSTRAINT_ENTRIES];
  legendre_pairs(u, t, parameters, mass);
  constraints_pairs(u, t, parameters, g);
  for (int e = 0; e < MASS_ENTRIES; e++)
    value[MASS_ENTRY[e][0]] = SUBTRACT(value[MASS_ENTRY[e][0]], MULTIPLY(mass[M + e], a[MASS_ENTRY[e][1]]));
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++) {
    const int row = CONSTRAINT_ENTRY[e][0], i = CONSTRAINT_ENTRY[e][1], j = M + CONSTRAINTS + row;
    value[i] = ADD(value[i], MULTIPLY(g[CONSTRAINTS + e], y[row]));
    value[j] = ADD(value[j], MULTIPLY(g[CONSTRAINTS + e], a[i]));
  }
}
#else
#define finish_position(t, u, parameters, at, q) (memcpy(q, u, sizeof(real) * M), OK)
#define subtract_solution(t, u, parameters, a, y, value) (void)0
#endif

/* Projects p onto the cotangent space of the constraints. */
static int project_momentum(scalar t, const scalar *q, scalar *p, const real *parameters, saddle *at, real *workspace)
{
  scalar u[2 * M], values[CONSTRAINTS + CONSTRAINT_ENTRIES], rate[CONSTRAINTS];
  real high[2 * M], g[CONSTRAINTS], right[CONSTRAINTS], y[CONSTRAINTS], update[M];
  real fastest = 0; /* the projection may be at rest */
  for (int k = 0; k < MOST_MOMENTUM_PROJECTIONS; k++) {
    TRY(constrained(t, q, p, parameters, u, values, rate, workspace));
    high_words(u, 2 * M, high);
    high_words(rate, CONSTRAINTS, right);
    TRY(factorise_saddle(IDEAL_FORCES, HIGH_WORD(t), high, parameters, at, g));
    solve_saddle(at, NULL, right, update, y);
    for (int e = 0; e < CONSTRAINT_ENTRIES; e++) {
      scalar *momentum = p + CONSTRAINT_ENTRY[e][1];
      *momentum = SUBTRACT(*momentum, MULTIPLY(values[CONSTRAINTS + e], SCALAR(y[CONSTRAINT_ENTRY[e][0]])));
    }
    fastest = larger(fastest, largest_magnitude(high + M, M));
    if (k + 1 >= MOMENTUM_PROJECTIONS && !(largest_magnitude(update, M) > SETTLED_MOMENTUM * fastest))
      break;
  }
  high_words(p, M, high);
  return all_finite(high, M) ? OK : NOT_FINITE;
}

/* Nearest state that satisfies the constraints; on failure q1 and p1 are unchanged. */
int NAME(project)(instant time, const real *q0, const real *p0, const real *parameters, real *q1, real *p1,
    real *workspace)
{
  saddle *at = saddle_in(workspace);
  const scalar t = TIME_OF(time);
  scalar q[M], p[M], v[M];
  real u[2 * M];
  load_scalars(q0, q);
  load_scalars(p0, p);
  TRY(velocities_of(t, q, p, parameters, v, workspace));
  high_words(q, M, u);
  high_words(v, M, u + M);
  TRY(project_position(HIGH_WORD(t), u, parameters, at));
  TRY(finish_position(t, u, parameters, at, q));
  TRY(project_momentum(t, q, p, parameters, at, workspace));
  TRY(store_scalars(q, q1));
  return store_scalars(p, p1);
}

static real product_of_vectors(const real *x, const real *y)
{
  real sum = 0;
  for (int i = 0; i < M; i++)
    sum += x[i] * y[i];
  return MATH(fabs)(sum);
}

/* Relative size of a difference d with the dual e, of vectors whose larger squared norm is `size`. */
static real relative_size(const real *d, const real *e, real size)
{
  return size > 0 ? MATH(sqrt)(product_of_vectors(d, e) / size) : 0;
}

/* Relative distances of two states: positions in the metric of the mass matrix, momenta in that of its inverse. */
int NAME(apart)(instant time, const real *q0, const real *p0, const real *q1, const real *p1, const real *parameters,
    real *apart, real *workspace)
{
  const scalar t = TIME_OF(time);
  scalar q[2][M], p[3][M], velocity[3][M]; /* of both states, and p = 0 */
  real u[2 * M], v[2][M], d[M], e[M], mass[MASS_ENTRIES], momentum[M];
  memset(p, 0, sizeof p);
  load_scalars(q0, q[0]);
  load_scalars(q1, q[1]);
  load_scalars(p0, p[0]);
  load_scalars(p1, p[1]);
  for (int k = 0; k < 3; k++)
    TRY(velocities_of(t, q[1], p[k], parameters, velocity[k], workspace));
  for (int i = 0; i < M; i++) {
    d[i] = HIGH_WORD(SUBTRACT(p[1][i], p[0][i]));
    e[i] = HIGH_WORD(SUBTRACT(velocity[1][i], velocity[0][i]));
    for (int k = 0; k < 2; k++)
      v[k][i] = HIGH_WORD(velocity[k][i]) - HIGH_WORD(velocity[2][i]);
    u[i] = q1[i], u[M + i] = HIGH_WORD(velocity[1][i]);
  }
  apart[1] = relative_size(d, e, larger(product_of_vectors(p0, v[0]), product_of_vectors(p1, v[1])));
  if (largest_magnitude(e, M) <= ROUNDED_UPDATE && apart[1] > ACCEPTED_UPDATE)
    apart[1] = ACCEPTED_UPDATE;
  legendre(u, HIGH_WORD(t), parameters, momentum, mass);
  for (int i = 0; i < M; i++)
    d[i] = HIGH_WORD(SUBTRACT(q[1][i], q[0][i]));
  times_mass(mass, d, e);
  times_mass(mass, q0, v[0]);
  times_mass(mass, q1, v[1]);
  apart[0] = relative_size(d, e,
      larger(larger(product_of_vectors(q0, v[0]), product_of_vectors(q1, v[1])),
          square_by_constraints(HIGH_WORD(t), q1, parameters, mass, saddle_in(workspace))));
  return all_finite(apart, 2) ? OK : NOT_FINITE;
}

/* Lagrange multipliers of d/dt L_v = L_q + f + G^T lambda, from L_vv a - G^T lambda = F, G a = -(remaining terms of the
 * second derivative of g). */
int NAME(multipliers)(long long count, const real *t, const real *q, const real *p, const real *parameters,
    real *multiplier, real *workspace)
{
  saddle *at = saddle_in(workspace);
  for (long long k = 0; k < count; k++) {
    const scalar now = TIME_AT(t, k);
    scalar x[M], u[2 * M], value[M + 2 * CONSTRAINTS], a[M], y[CONSTRAINTS];
    real high[2 * M], g[CONSTRAINTS], right[M + 2 * CONSTRAINTS], change[M], change_of_y[CONSTRAINTS];
    load_scalars(q + k * WORDS * M, u);
    load_scalars(p + k * WORDS * M, x);
    TRY(velocities_of(now, u, x, parameters, u + M, workspace));
    high_words(u, 2 * M, high);
    TRY(factorise_saddle(ACTUAL_FORCES, HIGH_WORD(now), high, parameters, at, g));
    memset(a, 0, sizeof a);
    memset(y, 0, sizeof y);
    for (int n = 0; n < REFINEMENTS; n++) {
      KERNEL_OF(constrained_motion)(u, now, parameters, value);
      subtract_solution(now, u, parameters, a, y, value);
      high_words(value, M + 2 * CONSTRAINTS, right);
      solve_saddle(at, right, right + M + CONSTRAINTS, change, change_of_y);
      for (int i = 0; i < M; i++)
        a[i] = ADD(a[i], SCALAR(change[i]));
      for (int j = 0; j < CONSTRAINTS; j++)
        y[j] = SUBTRACT(y[j], SCALAR(change_of_y[j]));
    }
    for (int j = 0; j < CONSTRAINTS; j++) {
      TRY(is_finite(HIGH_WORD(y[j])) ? OK : NOT_FINITE);
      PUT_WORDS(multiplier + k * WORDS * CONSTRAINTS, CONSTRAINTS, j, y[j]);
    }
  }
  return OK;
}

#ifdef MASKED_CONSTRAINTS
/* Masked constraints at a state, for the choice of their modes and for impacts: values g, rates G v + .., second rates
 * without forces of these constraints, rounding errors of g, the terms of second rates by whose rounding these differ,
 * |G M^-1| |F| + .., the matrix W = G M^-1 G^T by rows, G by rows, then the coefficients of the contacts and their
 * rounding errors. M^-1 includes the reactions of the other constraints. Parameters with masks of 0, and of 1. */
int NAME(contact_terms)(real t, const real *q, const real *p, const real *idle, const real *imposed, real *terms,
    real *workspace)
{
  enum { FIRST = CONSTRAINTS - MASKED };
  saddle *at = saddle_in(workspace);
  real *rate = terms + MASKED, *second = rate + MASKED, *size = second + MASKED, *second_terms = size + MASKED;
  real *W = second_terms + MASKED, *G = W + MASKED * MASKED;
  real u[2 * M], g[CONSTRAINTS], derivative[CONSTRAINT_ENTRIES], value[M + 2 * CONSTRAINTS], right[CONSTRAINTS] = {0};
  real x[M], y[CONSTRAINTS];
  TRY(find_velocity(t, q, p, idle, u + M, workspace));
  memcpy(u, q, sizeof(real) * M);
  TRY(factorise_saddle(IDEAL_FORCES, t, u, idle, at, g));
  constraints(u, t, imposed, g, derivative);
  constrained_motion(u, t, imposed, value);
  memcpy(terms, g + FIRST, sizeof(real) * MASKED);
  memcpy(rate, value + M + FIRST, sizeof(real) * MASKED);
  constraint_rounding(u, t, imposed, y);
  memcpy(size, y + FIRST, sizeof(real) * MASKED);
  memset(G, 0, sizeof(real) * MASKED * M);
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++)
    if (CONSTRAINT_ENTRY[e][0] >= FIRST)
      G[(CONSTRAINT_ENTRY[e][0] - FIRST) * M + CONSTRAINT_ENTRY[e][1]] = derivative[e];
  for (int k = 0; k < FIRST; k++)
    right[k] = value[M + CONSTRAINTS + k];
  constrained_motion(u, t, idle, value);
  memset(second_terms, 0, sizeof(real) * MASKED);
  for (int column = 0; column <= MASKED; column++) { /* the last one: free motion */
    const int is_free = column == MASKED;
    const real none[CONSTRAINTS] = {0};
    solve_saddle(at, is_free ? value : G + column * M, is_free ? right : none, x, y);
    for (int i = 0; i < M && !is_free; i++)
      second_terms[column] += MATH(fabs)(x[i] * value[i]);
    for (int row = 0; row < MASKED; row++) {
      real sum = 0;
      for (int i = 0; i < M; i++)
        sum += G[row * M + i] * x[i];
      if (is_free)
        second[row] = sum;
      else
        W[row * MASKED + column] = sum;
    }
  }
  constrained_motion(u, t, imposed, value);
  for (int k = 0; k < MASKED; k++) {
    second[k] += value[M + CONSTRAINTS + FIRST + k];
    second_terms[k] += MATH(fabs)(value[M + CONSTRAINTS + FIRST + k]);
  }
  contact_coefficients(u, t, imposed, G + MASKED * M);
  coefficient_rounding(u, t, imposed, G + MASKED * M + COEFFICIENTS);
  return all_finite(terms, MASKED * (5 + MASKED + M)) ? OK : NOT_FINITE;
}
#endif
