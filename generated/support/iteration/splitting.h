#ifndef SUPPORT_SPLITTING_H
#define SUPPORT_SPLITTING_H

/* Explicit splitting method (Hairer, Lubich & Wanner, Geometric Numerical Integration, sec. II.5): for every n
 *   p += h KICK[n] F(q, t + h KICK_ABSCISSA[n]),      q += h DRIFT[n] v,
 * with v = M^-1 p for constant masses (CONSTANT_MASSES), else v(p, t), for rigid bodies (ROTATING_BODIES) with the flow
 * of their kinetic energy in the time h DRIFT[n]. Of many trajectories, which are SIMD lanes, if LANES is
 * defined. Requires: step.h, status_codes.h; or trajectories.h. */
#ifndef LANES
typedef real number; /* a value of the trajectory */
#endif

#ifdef CONSTANT_MASSES
/* Drift with constant masses. Requires: the kernel mass. */
typedef struct {
  number inverse_mass[M];
} solver_data;

static void prepare(const step_data *step, solver_data *data)
{
  mass(NULL, step->t, step->parameters, data->inverse_mass);
  for (int i = 0; i < M; i++)
    data->inverse_mass[i] = 1 / data->inverse_mass[i];
}

/* Advances the positions by a part of the step with the momenta p0 + dp; adds their action, divided by h. */
static inline void drift(const step_data *step, const solver_data *data, real part, number *dp, number *dq,
    number *action)
{
  (void)action;
  for (int i = 0; i < M; i++) {
    const number p = step->p0[i] + (step->carry_p[i] + dp[i]);
    dq[i] += step->h * part * data->inverse_mass[i] * p;
#ifdef RUN_ACTION
    *action += part / 2 * data->inverse_mass[i] * p * p;
#endif
  }
}
#else
/* Drift with velocities v(p, t). Requires: the kernel drift_velocity; of bodies free_rotation.h. */
typedef struct {
#ifdef ROTATING_BODIES
  free_body bodies[BODIES];
#else
  int unused;
#endif
} solver_data;

static void prepare(const step_data *step, solver_data *data)
{
#ifdef ROTATING_BODIES
  real rates[3 * BODIES];
  turning(NULL, step->t, step->parameters, rates);
  for (int k = 0; k < BODIES; k++)
    data->bodies[k] = sorted_axes(BODY[k] + 1, rates + 3 * k);
#else
  (void)step;
  data->unused = 0;
#endif
}

/* Advances the positions by a part of the step with the momenta p0 + dp. */
static inline void drift(const step_data *step, const solver_data *data, real part, number *dp, number *dq,
    number *action)
{
  number p[M], v[M];
  (void)action;
  for (int i = 0; i < M; i++)
    p[i] = step->p0[i] + (step->carry_p[i] + dp[i]);
  drift_velocity(p, step->t, step->parameters, v);
  for (int i = 0; i < M; i++)
    dq[i] += step->h * part * v[i];
#ifdef ROTATING_BODIES
  for (int k = 0; k < BODIES; k++) {
    const int first = BODY[k][0];
    const real *axes = NULL;
#ifdef PRODUCTS_OF_INERTIA
    axes = PRINCIPAL_AXES[k];
#endif
    turn_body(
        step, first, BODY[k][2], data->bodies + k, axes, step->h * part, p + first, dq + first, dp + first);
  }
#else
  (void)data;
#endif
}
#endif

/* Requires: a drift, LEAPS, the tables, and the kernel force; with RUN_ACTION the kernel at_rest, L at v = 0. */

/* Computes the increments of one step. F is the last force; it is that of the first kick if `known`. With RUN_ACTION,
 * acted[0] is L at v = 0 at the last kick, and acted[1] the action of the step divided by h. */
SPLITTING void leap(const step_data *step, const solver_data *data, int known, number *F, number *dq, number *dp,
    number *acted)
{
  number u[M];
#ifdef RUN_ACTION
  acted[1] = 0;
#endif
  memset(dq, 0, sizeof(number) * M);
  memset(dp, 0, sizeof(number) * M);
  for (int n = 0; n < LEAPS; n++) {
    if (KICK[n] != 0) {
      for (int i = 0; i < M; i++)
        u[i] = step->q0[i] + (step->carry_q[i] + dq[i]);
      if (n > 0 || !known) {
        force(u, step->t + KICK_ABSCISSA[n] * step->h, step->parameters, F);
#ifdef RUN_ACTION
        at_rest(u, step->t + KICK_ABSCISSA[n] * step->h, step->parameters, acted);
#endif
      }
      for (int i = 0; i < M; i++)
        dp[i] += step->h * KICK[n] * F[i];
#ifdef RUN_ACTION
      acted[1] += KICK[n] * acted[0];
#endif
    }
    if (DRIFT[n] != 0)
      drift(step, data, DRIFT[n], dp, dq, acted + 1);
  }
}

#ifndef LANES
/* Computes the increments of one step; memory contains the last force, which the next step reuses if it starts with a
 * kick. */
SPLITTING int solve(const step_data *step, const solver_data *data, real *memory, long long *guess, real *dq, real *dp,
    const solver_options *options, solver_report *report, real *workspace)
{
  real F[M], acted[2];
  (void)options;
  (void)workspace;
  memcpy(F, memory, sizeof F);
#ifdef RUN_ACTION
  acted[0] = memory[M];
#endif
  leap(step, data, *guess > 0, F, dq, dp, acted);
  report->iterations++;
  if (!reaches(step, dq, dp))
    return NOT_FINITE;
  memcpy(memory, F, sizeof F);
#ifdef RUN_ACTION
  memory[M] = acted[0], memory[M + 1] = acted[1];
#endif
  *guess = 1;
  return OK;
}
#else
typedef solver_data iteration_data;

static void prepare_iteration(const step_data *step, iteration_data *data)
{
  prepare(step, data);
}

/* Computes the increments of one step of each trajectory; the last step has stored its last force. */
static inline void fixed_point(const step_data *step, const iteration_data *data, history past, long long *guess,
    lanes *dq, lanes *dp, const solver_options *options, solver_report *report)
{
  (void)options;
  number acted[2];
  memcpy(past.before[0], past.last[0], sizeof(lanes) * M);
  leap(step, data, *guess > 0, past.before[0], dq, dp, acted);
  report->iterations++;
  *guess = 1;
}
#endif

#endif
