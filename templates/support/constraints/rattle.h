#include "../mechanics/mass_system.h"
#include "multiplier_iteration.h"

/* Constrained steps on Lobatto points for a constant mass matrix M (RATTLE for two points; Lobatto IIIA-IIIB: L. Jay,
 * SIAM J. Numer. Anal. 33, 1996), without the full Newton matrix: iteration for the multipliers that give g = 0 at the
 * points, then the multipliers that project p1 onto the tangent space. With the accelerations a = M^-1 (F + G^T
 * lambda), F = L_q, positions are
 *
 *   u = q0 + h c v0 + h^2 R a,    v0 = M^-1 p0,
 *
 * c = RATTLE_DRIFT, R = RATTLE_RESPONSE. The correction of lambda at each point solves P dlambda = -G da - R^-1 g /
 * h^2, where da is the change of the accelerations since those of u, and P = G M^-1 G^T at this point. It neglects
 * that G varies between the points, an error of order h, and that F varies with u. With VELOCITY_FORCES F includes
 * forces that depend on the velocities of the curve at the points,
 *
 *   v = (1 + s) v0 + h V a,
 *
 * s = RATTLE_VELOCITY_START, 0 except for rounding, V = RATTLE_VELOCITY with its low words. With MOMENTUM_TERMS
 * momenta are M v + A(q, t), as in a magnetic field or a rotating frame: then v0 = M^-1 (p0 - A0), and with w = M^-1
 * (A - A0) at all points but the first the positions are less h Q w, Q = RATTLE_SHIFT with its low words, v is less
 * RATTLE_VELOCITY_SHIFT w, and da less R^-1 Q dw / h.
 *
 * Requires: multiplier_iteration.h with what it requires, the kernels constrained_force and, with MOMENTUM_TERMS,
 * constrained_momentum, A; the tables RATTLE_ABSCISSA, RATTLE_WEIGHT, RATTLE_START, RATTLE_MOMENTUM, RATTLE_RESPONSE
 * and RATTLE_DRIFT with their low words, RATTLE_INVERSE of R, and from the unknowns of the previous step
 * RATTLE_POSITIONS, in units of h, and RATTLE_MULTIPLIERS, padded with zeros; with VELOCITY_FORCES also
 * RATTLE_LAST_VELOCITY, from the velocities z of the step to that at the last point; with MOMENTUM_TERMS
 * RATTLE_SHIFT_RESPONSE, R^-1 Q, and RATTLE_PROJECTION, by which w reduces z. */

/* Positions u, forces F, derivatives G and g at all points but the first, where the second and third are first_force
 * and first_derivative; multipliers and the accelerations a of u at all but the last. `base` is u without forces. With
 * VELOCITY_FORCES force, positions `at` and velocities v are at all points but the last, and base_v is v without
 * forces. With MOMENTUM_TERMS A, w and its last change, at all points but the first, where A is first_A. */
typedef struct {
  number u[M][GROUP_LANES], force[M][GROUP_LANES], derivative[CONSTRAINT_ENTRIES][GROUP_LANES];
  lanes lambda[CONSTRAINTS][GROUPS];
#ifdef MOMENTUM_TERMS
  number w[M][GROUP_LANES];
#endif
  number g[CONSTRAINTS][GROUP_LANES], a[M][GROUP_LANES]; /* from here on not part of the solution */
#ifdef VELOCITY_FORCES
  number at[M][GROUP_LANES], v[M][GROUP_LANES];
  lanes base_v[M][GROUPS];
#endif
#ifdef MOMENTUM_TERMS
  number A[M][GROUP_LANES], change[M][GROUP_LANES], first_A[M];
#endif
  number first_derivative[CONSTRAINT_ENTRIES], first_force[M], inverse_mass[INVERSE_MASSES], v0[M];
  lanes base[M][GROUPS];
} rattle_step;

/* Constants of a run. */
typedef struct {
  number inverse_mass[INVERSE_MASSES];
} rattle_data;

#ifdef RATTLE_IN_PAIRS
/* Step that is continued in pairs, by_rattle: if RATTLE solved it, and M^-1 in pairs. */
typedef struct {
  int by_rattle;
  dd inverse_mass[INVERSE_MASSES];
  rattle_step now;
} solved_step;

#define POINTS_OF_STEP(name) solved_step name
#endif

/* Computes the lower half of M^-1; NaN if M is singular. Coordinates that no masses couple share a solution. */
static void invert_constant_masses(real t, const real *parameters, real *mass, real *inverse)
{
  real u[2 * M] = {0}, p[M], pivot[M], x[M];
  int regular;
  transform_and_derivatives(t, u, parameters, p, mass);
  regular = factorise_masses(mass, pivot) == OK;
  for (int column = 0; column < MASS_COLUMNS; column++) {
    for (int i = 0; i < M; i++)
      x[i] = MASS_COLUMN[i] == column;
    if (regular)
      solve_masses(mass, pivot, x);
    for (int e = 0; e < INVERSE_MASSES; e++)
      if (MASS_COLUMN[INVERSE_MASS_ENTRY[e][1]] == column)
        inverse[e] = regular ? x[INVERSE_MASS_ENTRY[e][0]] : (real)NAN;
  }
}

static void prepare_rattle(const step_data *step, rattle_data *data)
{
#ifdef TRAJECTORIES_AS_LANES
  real mass[SCRATCH], inverse[INVERSE_MASSES], parameters[P + 1];
  for (int j = 0; j < LANES; j++) {
    TAKE_LANE(parameters, P, step->parameters, j);
    invert_constant_masses(step->t, parameters, mass, inverse);
    PUT_LANE(data->inverse_mass, INVERSE_MASSES, j, inverse);
  }
#else
  invert_constant_masses(step->t, step->parameters, step->scratch, data->inverse_mass);
#endif
}

#include "iterate.h"

#ifndef VELOCITY_FORCES
#define move_points(step, now) (void)0
#endif

#ifdef MOMENTUM_TERMS
/* Computes w at all points but the first, and its change. */
static inline __attribute__((flatten)) void evaluate_momenta(const step_data *step, rattle_step *restrict now)
{
  for (int n = 0; n < GROUP_LANES; n++) {
    number u[M], A[M];
    TAKE_LANE(u, M, now->u, n);
    constrained_momentum(u, step->t + RATTLE_ABSCISSA[n + 1] * step->h, step->parameters, A);
    for (int i = 0; i < M; i++)
      now->A[i][n] = A[i] - now->first_A[i];
  }
  find_shifts(step, now);
  IN_MEMORY(now->change);
  IN_MEMORY(now->w);
}
#else
#define evaluate_momenta(step, now) (void)0
#endif

/* Evaluates forces, constraints and their derivatives. */
static __attribute__((flatten)) void evaluate_points(const step_data *step, rattle_step *restrict now)
{
  evaluate_momenta(step, now);
  move_points(step, now);
  for (int n = 0; n < GROUP_LANES; n++) {
    number u[M], force[M], g[CONSTRAINTS], derivative[CONSTRAINT_ENTRIES];
    const real t = step->t + RATTLE_ABSCISSA[n + 1] * step->h;
    TAKE_LANE(u, M, now->u, n);
#ifdef VELOCITY_FORCES
    number moving[2 * M];
    TAKE_LANE(moving, M, now->at, n);
    TAKE_LANE(moving + M, M, now->v, n);
    constrained_force(moving, step->t + RATTLE_ABSCISSA[n] * step->h, step->parameters, force);
#else
    constrained_force(u, t, step->parameters, force);
#endif
    constraints(u, t, step->parameters, g, derivative);
    PUT_LANE(now->force, M, n, force);
    PUT_LANE(now->g, CONSTRAINTS, n, g);
    PUT_LANE(now->derivative, CONSTRAINT_ENTRIES, n, derivative);
  }
}

/* Derivatives at all points but the last. */
static inline void former_derivatives(const rattle_step *now, int g, lanes *derivative)
{
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++)
    derivative[e] = former(now->derivative[e], now->first_derivative[e], g);
}

/* Sizes of the terms of the displacements, with reactions if requested. */
static inline void term_sizes(const step_data *step, rattle_step *now, int reactions, number *size)
{
#ifdef VELOCITY_FORCES
  number force[M];
  TAKE_LANE(force, M, now->force, 0);
#else
  const number *force = now->first_force;
#endif
  find_term_sizes(step, force, now->first_derivative, reactions ? now->lambda : NULL, now->inverse_mass, size);
}

/* Values at the first point, and v0. */
static inline void begin_first(const step_data *step, rattle_step *now)
{
  number constraint[CONSTRAINTS], p0[M];
  memcpy(p0, step->p0, sizeof p0);
#ifndef VELOCITY_FORCES
  constrained_force(step->q0, step->t, step->parameters, now->first_force);
#endif
  constraints(step->q0, step->t, step->parameters, constraint, now->first_derivative);
#ifdef MOMENTUM_TERMS
  constrained_momentum(step->q0, step->t, step->parameters, now->first_A);
  for (int i = 0; i < M; i++)
    p0[i] -= now->first_A[i];
  memset(now->w, 0, sizeof now->w);
#endif
  find_velocities(now->inverse_mass, p0, now->v0);
}

/* Initial values: the first point, and a guess of the others from the unknowns of the previous step, or if they are
 * NULL motion without forces, of the velocities `start` where masses depend on positions. Rounded tables would be
 * those of another method, whose energy drifts: the low words of R act on the guess of the accelerations. */
static void begin(const step_data *step, const rattle_data *run, const number *memory, const number *start,
    rattle_step *now)
{
  number forced[M][GROUP_LANES]; /* displacements by accelerations, divided by h */
  memcpy(now->inverse_mass, run->inverse_mass, sizeof now->inverse_mass);
  begin_first(step, now);
  for (int i = 0; i < M; i++)
    for (int g = 0; g < GROUPS; g++) {
      const lanes z = memory ? times(RATTLE_POSITIONS, B, memory + i * B, g) : lanes_of(0);
      const lanes drift = weights(RATTLE_DRIFT, g);
      const lanes moved = memory ? step->h * z : drift * (step->h * now->v0[i]);
      store(now->u[i], g, step->q0[i] + (step->carry_q[i] + moved));
      store(forced[i], g, memory ? z - drift * now->v0[i] : z);
    }
  IN_MEMORY(forced);
  evaluate_momenta(step, now);
  begin_points(step, now, forced);
  for (int k = 0; k < CONSTRAINTS; k++)
    for (int g = 0; g < GROUPS; g++)
      now->lambda[k][g] = memory ? times(RATTLE_MULTIPLIERS, B, memory + (M + k) * B, g) : lanes_of(0);
  evaluate_points(step, now);
}

/* Force at the last point, where the velocity is that of the curve with velocities z. */
static inline void last_force(const step_data *step, const rattle_step *now, const number *z, number *force)
{
#ifdef VELOCITY_FORCES
  number u[2 * M] = {0};
  for (int i = 0; i < M; i++) {
    u[i] = now->u[i][DEGREE - 1];
    for (int b = 0; b < DEGREE; b++)
      u[M + i] += RATTLE_LAST_VELOCITY[b] * z[i * B + b];
  }
  constrained_force(u, step->t + RATTLE_ABSCISSA[DEGREE] * step->h, step->parameters, force);
#else
  TAKE_LANE(force, M, now->force, DEGREE - 1);
#endif
}

#define END_MASSES(now) (now)->inverse_mass /* inverted, at the end */

/* Velocities at the end, where the momenta are p0 + dp. */
static inline void end_velocity(const step_data *step, const rattle_step *now, const number *dp, number *v)
{
  find_velocities(now->inverse_mass, dp, v);
  for (int i = 0; i < M; i++) {
    v[i] += now->v0[i];
#ifdef MOMENTUM_TERMS
    v[i] -= now->w[i][DEGREE - 1];
#endif
  }
}

/* Velocities z of the curve, and p1 - p0 before the projection. */
static inline void finish_curve(const step_data *step, rattle_step *now, number *velocities, number *dp)
{
  number force[M], all[M][GROUP_LANES], z[M][GROUP_LANES];
  finish_points(step, now, all, z);
  for (int i = 0; i < M; i++)
    memcpy(velocities + i * B, z[i], sizeof(number) * DEGREE);
  last_force(step, now, velocities, force);
  for (int i = 0; i < M; i++) {
    number sum = RATTLE_WEIGHT[DEGREE] * force[i];
    for (int n = 0; n < DEGREE; n++)
      sum += RATTLE_WEIGHT[n] * all[i][n];
    dp[i] = step->h * sum;
  }
}
