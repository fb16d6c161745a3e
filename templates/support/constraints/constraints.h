#include "../core/status_codes.h"
#include "../core/step.h"
#include "../newton/band.h"

/* Projection onto holonomic constraints g(q, t) = 0 or linear velocity constraints A(q, t) v + b = 0, and Lagrange
 * multipliers. For the latter, g = 0 and A v + b is the constraint rate.
 *
 * Positions: Gauss-Newton iteration in the metric of the mass matrix; momenta: p -= G^T y with G H_pp G^T y = rate
 * (Hairer, Lubich & Wanner, Geometric Numerical Integration, sec. VII.1). Requires: legendre.h, the kernels
 * constraints, constraint_rounding and constrained_motion, and CONSTRAINT_ENTRY, the indices of the entries of G = g_q
 * or A. With MASKED_CONSTRAINTS g and G are multiplied by masks c, the matrix is [L_vv, G^T; G, 1 - c], and [L_vv, D^T;
 * G, 1 - c] for the multipliers of forces D^T lambda: requires the kernel reactions, of 1 - c and the entries of D,
 * whose indices are DIRECTION_ENTRY. */

#define MAX_PROJECTIONS 1000 /* Gauss-Newton iterations: unequal masses far away need hundreds */
#define MOST_UPDATE_HALVINGS 60 /* of an update */
#define MOMENTUM_PROJECTIONS 3 /* one suffices except for rounding and non-quadratic kinetic energies, for which the
                                * iteration continues until an update of the velocity, relative to it, is settled */
#define MOST_MOMENTUM_PROJECTIONS 100
#define SETTLED_UPDATE REAL(1e-9)
/* relative to the state: accepted size of the last update where rounding prevents a smaller residual */
#define ACCEPTED_UPDATE REAL(1e-6)
#define ROUNDED_UPDATE (1024 * REAL_EPSILON) /* at rest, where a relative distance is undefined */
#define ROUNDED_RESIDUAL (4 * REAL_EPSILON) /* times the rounding size of g: residuals that an update does not reduce */

enum { IDEAL_FORCES,
  ACTUAL_FORCES }; /* G^T, of projections, and D^T, of multipliers */

/* Factors of the saddle-point matrix [L_vv, G^T; G, 0] of a state, and a right-hand side. */
typedef struct {
  real matrix[SADDLE], pivot[SITES], x[SITES];
} saddle;

/* In the memory of the kernels, which are not evaluated while it is used. */
static saddle *saddle_in(real *workspace)
{
  return (saddle *)workspace;
}

#ifdef MASKED_CONSTRAINTS
/* Adds the masks to the matrix, and replaces G^T by D^T of the actual forces. */
static void add_reactions(real t, const real *u, const real *parameters, int forces, const band *shape, real *matrix)
{
  real idle[CONSTRAINTS], direction[DIRECTION_ENTRIES];
  reactions(u, t, parameters, idle, direction);
  for (int k = 0; k < CONSTRAINTS; k++)
    matrix[shape->first + POSITION_IN_MATRIX[M + k] * (shape->stride + 1)] = idle[k];
  for (int e = 0; forces == ACTUAL_FORCES && e < CONSTRAINT_ENTRIES; e++)
    matrix[shape->first + POSITION_IN_MATRIX[M + CONSTRAINT_ENTRY[e][0]] * shape->stride +
        POSITION_IN_MATRIX[CONSTRAINT_ENTRY[e][1]]] = 0;
  for (int e = 0; forces == ACTUAL_FORCES && e < DIRECTION_ENTRIES; e++)
    matrix[shape->first + POSITION_IN_MATRIX[M + DIRECTION_ENTRY[e][0]] * shape->stride +
        POSITION_IN_MATRIX[DIRECTION_ENTRY[e][1]]] = direction[e];
}
#endif

/* Factorises the matrix at u = (q, v), with the given kind of forces, and computes g. */
static int factorise_saddle(int forces, real t, const real *u, const real *parameters, saddle *at, real *g)
{
  const band shape = band_of(SITES, 1);
  real p[M], mass[MASS_ENTRIES], derivative[CONSTRAINT_ENTRIES];
  legendre(u, t, parameters, p, mass);
  constraints(u, t, parameters, g, derivative);
  memset(at->matrix, 0, sizeof(real) * band_size(&shape));
  for (int e = 0; e < MASS_ENTRIES; e++)
    at->matrix[shape.first + POSITION_IN_MATRIX[MASS_ENTRY[e][1]] * shape.stride +
        POSITION_IN_MATRIX[MASS_ENTRY[e][0]]] = mass[e];
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++) {
    const int row = POSITION_IN_MATRIX[M + CONSTRAINT_ENTRY[e][0]], column = POSITION_IN_MATRIX[CONSTRAINT_ENTRY[e][1]];
    at->matrix[shape.first + column * shape.stride + row] = derivative[e];
    at->matrix[shape.first + row * shape.stride + column] = derivative[e];
  }
#ifdef MASKED_CONSTRAINTS
  add_reactions(t, u, parameters, forces, &shape, at->matrix);
#endif
  TRY(all_finite(g, CONSTRAINTS) && all_finite(at->matrix, (int)band_size(&shape)) ? OK : NOT_FINITE);
  return factorise(at->matrix, &shape, at->pivot) ? OK : SINGULAR;
}

/* Solves L_vv x + G^T y = a (0 if NULL), G x = -b. */
static void solve_saddle(saddle *at, const real *a, const real *b, real *x, real *y)
{
  const band shape = band_of(SITES, 1);
  for (int i = 0; i < M; i++)
    at->x[POSITION_IN_MATRIX[i]] = a ? a[i] : 0;
  for (int k = 0; k < CONSTRAINTS; k++)
    at->x[POSITION_IN_MATRIX[M + k]] = -b[k];
  back_substitute(at->matrix, &shape, at->pivot, at->x);
  for (int i = 0; i < M; i++)
    x[i] = at->x[POSITION_IN_MATRIX[i]];
  for (int k = 0; k < CONSTRAINTS; k++)
    y[k] = at->x[POSITION_IN_MATRIX[M + k]];
}

/* Adds to the sizes of positions the displacements for which constraints change by the sizes of their terms: rounding
 * leaves g_k = O(u r_k), with the rounding size r of constraint_rounding, and positions q + X_k g_k, X = M^-1 D^T (G
 * M^-1 D^T)^-1, whatever |q| is: with ideal forces D = G, with actual ones X grows near Painleve's paradox. Nothing is
 * added where the constraints are dependent. */
static SELDOM void add_constraint_sizes(int forces, real t, const real *q, const real *parameters, saddle *at,
    real *size)
{
  real u[2 * M] = {0}, g[CONSTRAINTS], rounding[CONSTRAINTS], x[M], y[CONSTRAINTS];
  memcpy(u, q, sizeof(real) * M);
  if (factorise_saddle(forces, t, u, parameters, at, g) != OK)
    return;
  constraint_rounding(u, t, parameters, rounding);
  for (int k = 0; k < CONSTRAINTS; k++) {
    memset(g, 0, sizeof g);
    g[k] = -rounding[k];
    solve_saddle(at, NULL, g, x, y);
    for (int i = 0; i < M && all_finite(x, M); i++)
      size[i] += MATH(fabs)(x[i]);
  }
}

/* Displacement of the heaviest body by the reactions lambda among unknowns z, h^2 |G^T lambda| / M, 0 without unknowns:
 * at rest they cancel the other forces, whose rounding remains, where positions and terms of constraints may vanish.
 * Reactions on light bodies cancel each other, too. Their impulse, |h G^T lambda|, in *impulse. */
static SELDOM real displacement_by_reactions(const step_data *step, const real *z, real *impulse)
{
  real u[2 * M] = {0}, p[M], mass[MASS_ENTRIES], g[CONSTRAINTS], derivative[CONSTRAINT_ENTRIES], force[M] = {0};
  *impulse = 0;
  if (!z)
    return 0;
  memcpy(u, step->q0, sizeof(real) * M);
  legendre(u, step->t, step->parameters, p, mass);
  constraints(u, step->t, step->parameters, g, derivative);
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++) {
    real strongest = 0;
    for (int b = 0; b < B; b++)
      strongest = larger(strongest, MATH(fabs)(z[(M + CONSTRAINT_ENTRY[e][0]) * B + b]));
    force[CONSTRAINT_ENTRY[e][1]] += MATH(fabs)(derivative[e]) * strongest;
  }
  const real heaviest = largest_magnitude(mass, MASS_ENTRIES);
  *impulse = MATH(fabs)(step->h) * largest_magnitude(force, M);
  return heaviest > 0 ? MATH(fabs)(step->h) * *impulse / heaviest : 0;
}

#ifndef BARE_STEPS
/* Unknowns of the last solved step of a run. */
static inline const real *last_unknowns(const step_data *step)
{
  return step->motion_of ? step->motion_of->memory : NULL;
}

/* Largest size of positions that round as the constraints and reactions do, whatever the positions are. */
static SELDOM real size_by_constraints(const step_data *step)
{
  real size[M] = {0}, impulse;
  add_constraint_sizes(ACTUAL_FORCES, step->t, step->q0, step->parameters, saddle_in(step->scratch), size);
  return largest_magnitude(size, M) + displacement_by_reactions(step, last_unknowns(step), &impulse);
}

/* Displacements relative to which positions on constraints are rounded, whatever they are: those by reactions, the
 * largest one d that changes one constraint by the size of its terms r_k, and, as light bodies yield, X_k r_k, which is
 * at most d sqrt(M / m_i) with the heaviest mass M. Unlike X_k alone they are bounded where the constraints become
 * dependent: errors grow there, and are not to be taken for rounding. */
static SELDOM void lengths_of_constraints(const step_data *step, real *lengths)
{
  real g[CONSTRAINTS], rounding[CONSTRAINTS], steepest[CONSTRAINTS] = {0}, derivative[CONSTRAINT_ENTRIES], length = 0;
  real u[2 * M] = {0}, p[M], mass[MASS_ENTRIES], lightest[M] = {0}, yields[M] = {0};
  real impulse;
  const real by_reactions = displacement_by_reactions(step, last_unknowns(step), &impulse);
  memcpy(u, step->q0, sizeof(real) * M);
  legendre(u, step->t, step->parameters, p, mass);
  constraints(u, step->t, step->parameters, g, derivative);
  constraint_rounding(u, step->t, step->parameters, rounding);
  for (int e = 0; e < MASS_ENTRIES; e++)
    if (MASS_ENTRY[e][0] == MASS_ENTRY[e][1])
      lightest[MASS_ENTRY[e][0]] = MATH(fabs)(mass[e]);
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++)
    steepest[CONSTRAINT_ENTRY[e][0]] = larger(steepest[CONSTRAINT_ENTRY[e][0]], MATH(fabs)(derivative[e]));
  for (int k = 0; k < CONSTRAINTS; k++)
    if (steepest[k] > 0)
      length = larger(length, rounding[k] / steepest[k]);
  add_constraint_sizes(ACTUAL_FORCES, step->t, step->q0, step->parameters, saddle_in(step->scratch), yields);
  for (int i = 0; i < M; i++) {
    const real most = length * MATH(sqrt)(largest_magnitude(lightest, M) / lightest[i]); /* infinite without a mass */
    lengths[i] = by_reactions + larger(length, yields[i] < most ? yields[i] : most);
  }
}
#endif

/* Sum of the squares of g relative to its sizes; infinite if g is not finite. */
static real misfit(const real *g, const real *size)
{
  real sum = 0;
  for (int k = 0; k < CONSTRAINTS; k++)
    sum += size[k] > 0 ? (g[k] / size[k]) * (g[k] / size[k]) : 0;
  return all_finite(g, CONSTRAINTS) ? sum : (real)INFINITY;
}

/* Returns 1 if |g_k| <= limit size_k for all k. */
static int is_below(const real *g, real limit, const real *size)
{
  int below = 1;
  for (int k = 0; k < CONSTRAINTS; k++)
    below &= MATH(fabs)(g[k]) <= limit * size[k] + REAL_MIN;
  return below;
}

/* Adds to the sizes of g those by which an update of squared length x^T L_vv x rounds: |x_i| <= |x| / sqrt(m_i), and g
 * may depend on a position that is 0. */
static void add_size_of_update(real t, const real *u, const real *parameters, real square, real *size)
{
  real p[M], mass[MASS_ENTRIES], g[CONSTRAINTS], derivative[CONSTRAINT_ENTRIES], longest[M] = {0};
  legendre(u, t, parameters, p, mass);
  constraints(u, t, parameters, g, derivative);
  for (int e = 0; e < MASS_ENTRIES; e++)
    if (MASS_ENTRY[e][0] == MASS_ENTRY[e][1] && mass[e] != 0)
      longest[MASS_ENTRY[e][0]] = MATH(sqrt)(MATH(fabs)(square / mass[e]));
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++)
    size[CONSTRAINT_ENTRY[e][0]] += MATH(fabs)(derivative[e]) * longest[CONSTRAINT_ENTRY[e][1]];
}

/* Projects q onto g = 0 by Gauss-Newton steps in the metric of the mass matrix at u = (q, v). An update is halved while
 * it does not reduce g; the iteration ends where g is a rounding error, whose size is that of its terms and of the
 * updates: positions may be 0. */
static int project_position(real t, real *u, const real *parameters, saddle *at)
{
  real g[CONSTRAINTS], y[CONSTRAINTS], update[M], nearest[M], size[CONSTRAINTS],
      derivative[CONSTRAINT_ENTRIES], last = 0;
  for (int k = 0; k < MAX_PROJECTIONS; k++) {
    int halvings = 0, is_rounding;
    real left, now, square = 0;
    TRY(factorise_saddle(IDEAL_FORCES, t, u, parameters, at, g));
    constraint_rounding(u, t, parameters, size);
    if (is_below(g, REAL_EPSILON / 2, size))
      return OK;
    solve_saddle(at, NULL, g, update, y);
    TRY(all_finite(update, M) ? OK : SINGULAR);
    for (int j = 0; j < CONSTRAINTS; j++)
      square += g[j] * y[j]; /* x^T L_vv x, as L_vv x = -G^T y */
    add_size_of_update(t, u, parameters, larger(MATH(fabs)(square), last), size);
    is_rounding = is_below(g, ROUNDED_RESIDUAL, size);
    last = MATH(fabs)(square);
    left = misfit(g, size);
    memcpy(nearest, u, sizeof nearest);
    do {
      for (int i = 0; i < M; i++)
        u[i] = nearest[i] + MATH(ldexp)(update[i], -halvings);
      constraints(u, t, parameters, g, derivative);
      now = misfit(g, size);
    } while (!(now < left) && !is_rounding && ++halvings < MOST_UPDATE_HALVINGS);
    if (!(now < left)) {
      memcpy(u, nearest, sizeof nearest);
      return is_rounding ? OK : NOT_CONVERGED;
    }
  }
  return NOT_CONVERGED;
}

/* y = L_vv x. */
static void times_mass(const real *mass, const real *x, real *y)
{
  memset(y, 0, sizeof(real) * M);
  for (int e = 0; e < MASS_ENTRIES; e++)
    y[MASS_ENTRY[e][0]] += mass[e] * x[MASS_ENTRY[e][1]];
}

/* Squared norm, in the metric of the mass matrix, of displacements by which constraints change by the sizes of their
 * terms: a distance of positions that may be 0 is relative to this. */
static real square_by_constraints(real t, const real *q, const real *parameters, const real *mass, saddle *at)
{
  real size[M] = {0}, dual[M], square = 0;
  add_constraint_sizes(IDEAL_FORCES, t, q, parameters, at, size);
  times_mass(mass, size, dual);
  for (int i = 0; i < M; i++)
    square += size[i] * dual[i];
  return MATH(fabs)(square);
}
