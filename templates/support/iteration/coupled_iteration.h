#include "convergence.h"
#include "corrections.h"

/* Fixed-point iteration of a step for any regular Lagrangian L(q, v, t). With the weights beta and w, the velocities z
 * at the points satisfy L_v(q_n, z_n) = P_n, where
 *   q_n = q0 + h sum_j POSITION_nj beta_j z_j,      P_n = p0 + h sum_j MOMENTUM_nj w_j L_q(q_j, z_j),
 * and an iteration is z_n += L_vv^-1 (P_n - L_v(q_n, z_n)). Requires: points.h or trajectories.h with what they
 * require, point_weights.h, a mass, corrections.h, velocity corrections, the tables, the kernel point_lanes. */

#ifdef FROZEN_MASS
/* The mass matrices are those of the first of MASS_AGE iterations, which is at extrapolated points: their errors are
 * small and affect only the convergence rate. Requires: the kernels value_lanes and mass_lanes, not point_lanes. */
enum { MASS_AGE = 16 };
#ifndef PROJECTED
#define COSTLY_POINTS /* their evaluation takes longer than a table of the predictor */
#endif
#include "secants.h"
#endif

#ifdef MIXED_VELOCITIES
/* Step in double, which mixed_velocities.h corrects. */
typedef struct {
  int by_iteration; /* 0 if Newton's method solved it */
  coordinates z[GROUPS];
} solved_step;
#undef POINTS_OF_STEP
#define POINTS_OF_STEP(name) solved_step name
#endif

#ifndef POINTS
/* Stores the velocities and forces of the trajectories that converge before others. */
static __attribute__((noinline)) void keep_early(const step_data *step, const iteration_data *data,
    lanes (*value)[VALUES], lanes (*z)[M], lanes (*r)[M], progress *now, coordinates (*stored)[S])
{
#ifdef FOLLOWED
  coordinates F[S];
  converged_forces(step, data, value, z, r, F);
  store_early(now, F[0], stored[1][0]);
#endif
  store_early(now, z[0], stored[0][0]);
  mark_stored(now);
}
#endif

/* Computes the increments of one step: the velocities z at the points are corrected by mass^-1 (P - L_v) until they
 * converge; the increments follow from the forces at the converged points. The velocities are stored for the predictor.
 * On failure the increments are undefined. */
HOT int fixed_point(const step_data *step, const iteration_data *data, history past, long long *steps, number *dq,
    number *dp, const solver_options *options, solver_report *report)
{
  coordinates own[GROUPS], *z = kept(past, own);
  lanes u[2 * M], value[GROUPS][VALUES], scaled[GROUPS][M], impulse[GROUPS][M], r[GROUPS][M], mass[GROUPS][MASS];
  number inverse_size[M] = {0.0};
  progress now = before_iterations();
#ifndef POINTS
  coordinates stored[2][S];
#endif
#ifdef SUPPORT_SECANTS_H
  secants before;
  before.begun = number_of(0.0);
#endif
  if (*steps > 0)
    continue_curve(step, past, *steps, z);
  else
    TRY(start_velocities(step, z));
  for (int k = 0; needs_iteration(&now); k++) {
    point_sums change = {lanes_of(0.0)};
    scale(data->position_weight, z, scaled);
#ifdef FROZEN_MASS
    if (k % MASS_AGE == 0)
      memset(mass, 0, sizeof mass);
#else
    if (!DIAGONAL)
      memset(mass, 0, sizeof mass);
#endif
    for (int n = 0; n < GROUPS; n++) {
      place(step, n, scaled, z, u);
#ifdef FROZEN_MASS
      value_lanes(u, step->t + step->h * ABSCISSA[n], step->parameters, value[n]);
      if (k % MASS_AGE == 0) {
        mass_lanes(u, step->t + step->h * ABSCISSA[n], step->parameters, mass[n]);
#ifdef DAMPED
        grow(&data->damping, n, MASS, mass[n]);
#endif
        factor_mass(mass[n]);
      }
#else
      point_lanes(u, step->t + step->h * ABSCISSA[n], step->parameters, value[n], mass[n]);
#endif
#ifdef DAMPED
      grow(&data->damping, n, VALUES, value[n]);
#ifndef FROZEN_MASS
      grow(&data->damping, n, MASS, mass[n]);
#endif
#endif
      for (int i = 0; i < M; i++)
        impulse[n][i] = data->momentum_weight[n] * value[n][i];
    }
#ifdef PROJECTED
    {
      lanes momentum[GROUPS][M], residual[GROUPS][M];
      for (int n = 0; n < GROUPS; n++)
        memcpy(momentum[n], value[n] + M, sizeof momentum[n]);
      for (int n = 0; n < GROUPS; n++)
        for (int i = 0; i < M; i++) {
          const lanes P = step->p0[i] + (step->carry_p[i] + apply(MOMENTUM, n, impulse, i));
          residual[n][i] = P - apply(PROJECTION, n, momentum, i);
        }
      for (int n = 0; n < GROUPS; n++) {
        for (int i = 0; i < M; i++)
          r[n][i] = apply(VELOCITY, n, residual, i);
#ifndef FROZEN_MASS
        factor_mass(mass[n]);
#endif
        solve_mass(mass[n], r[n]);
      }
      memcpy(residual, r, sizeof r);
      for (int n = 0; n < GROUPS; n++)
        for (int i = 0; i < M; i++) {
          r[n][i] = apply(PROJECTION, n, residual, i);
          z[n][i] += r[n][i];
        }
    }
#else
    for (int n = 0; n < GROUPS; n++) {
      for (int i = 0; i < M; i++)
        r[n][i] = step->p0[i] + (step->carry_p[i] + apply(MOMENTUM, n, impulse, i)) - value[n][M + i];
#ifndef FROZEN_MASS
      factor_mass(mass[n]);
#endif
    }
    correct(data, value, mass, r);
    for (int n = 0; n < GROUPS; n++)
      for (int i = 0; i < M; i++)
        z[n][i] += r[n][i];
#endif
    if (k == 0)
      measure_ends(z[0], M, options, fabs(step->h), inverse_size);
    for (int n = 0; n < GROUPS; n++)
      for (int i = 0; i < M; i++) {
        const lanes moved = r[n][i] * inverse_size[i];
        *sum_at(change, n) += CHANGES_OF(n) * (moved * moved);
      }
    take_change(&now, total_of(change), options, k, report);
    if (is_stagnant(&now, options, k))
      measure_by_largest(stagnant(&now), inverse_size);
#ifdef SUPPORT_SECANTS_H
    if (k >= FIRST_ITERATIONS && begins(&before, undecided(&now, ACCELERATED_LEVEL)))
      accelerate(&before, k, k % MASS_AGE == 0, inverse_size, before.begun * undecided(&now, CERTAIN_ROUNDING), r, z);
#endif
    if (must_amplify(&now, options, k))
      for (int n = 0; n < GROUPS; n++)
        for (int i = 0; i < M; i++)
          z[n][i] += amplification(&now) * r[n][i];
#ifndef POINTS
    if (converge_early(&now))
      keep_early(step, data, value, z, r, &now, stored);
#endif
  }
#ifndef POINTS
  restore_early(&now, stored[0][0], z[0]);
#endif
  TRY(outcome(&now, report));
  converged_forces(step, data, value, z, r, impulse);
#if defined(FOLLOWED) && !defined(POINTS)
  restore_early(&now, stored[1][0], impulse[0]);
#endif
  scale(data->momentum_weight, impulse, impulse);
  scale(data->position_weight, z, scaled);
  for (int i = 0; i < M; i++) {
    dq[i] = weigh(POINT_END_POSITION, scaled, i);
    dp[i] = weigh(POINT_END_MOMENTUM, impulse, i);
#ifdef DAMPED
    dp[i] = data->damping.shrunk * dp[i] + data->damping.loss * (step->p0[i] + step->carry_p[i]);
#endif
  }
  TRY(accept(step, dq, dp));
  remember_curve(z, past);
#ifdef MIXED_VELOCITIES
  if (step->points) {
    solved_step *solved = (solved_step *)step->points;
    solved->by_iteration = 1;
    memcpy(solved->z, z, sizeof solved->z);
  }
#endif
  *steps = next_guess(*steps, &now, report);
  return OK;
}

#if defined(TIME_TRANSFORMATION) || defined(RUN_ACTION)
/* Integrals along a step solved by fixed-point iteration. Requires: the kernel integrand_lanes. */

/* Quadrature of the momenta at the converged velocities, which `memory` contains. */
static inline void integrals_of_iteration(const step_data *step, const iteration_data *data, const double *memory,
    double *sum)
{
  lanes z[GROUPS][M], scaled[GROUPS][M], u[2 * M], value[INTEGRALS], part[INTEGRALS][GROUPS];
  lanes_load(memory, z);
  scale(data->position_weight, z, scaled);
  for (int n = 0; n < GROUPS; n++) {
    place(step, n, scaled, z, u);
    integrand_lanes(u, step->t + step->h * ABSCISSA[n], step->parameters, value);
    for (int k = 0; k < INTEGRALS; k++)
      part[k][n] = POINT_END_MOMENTUM[n] * (data->momentum_weight[n] * value[k]);
  }
  for (int k = 0; k < INTEGRALS; k++)
    sum[k] = points_total(part[k]);
}
#endif
