/* Explicit splitting method (Hairer, Lubich & Wanner, Geometric Numerical Integration, sec. II.5): for every n
 *   p += h KICK[n] F(q, t + h KICK_ABSCISSA[n]),      q += h DRIFT[n] v. */

/* v = M^-1 p for constant masses (CONSTANT_MASSES), else v(p, t), for rigid bodies (ROTATING_BODIES) with the flow of
 * their kinetic energy in the time h DRIFT[n]. Of many trajectories, which are SIMD lanes, if LANES is defined.
 * Requires: step.h, status_codes.h; or trajectories.h. */

#if !defined(LANES) && !defined(ROTATING_BODIES)
typedef real number; /* a value of the trajectory */
#endif

/* Constants of the drifts. Requires: of constant masses the kernel mass, else drift_velocity; of bodies
 * free_rotation.h. */
typedef struct {
#ifdef CONSTANT_MASSES
  number inverse_mass[M];
#elif defined(ROTATING_BODIES)
  free_body bodies[BODIES];
#else
  int unused;
#endif
} solver_data;

static void prepare(const step_data *step, solver_data *data)
{
#ifdef CONSTANT_MASSES
  mass(NULL, step->t, step->parameters, data->inverse_mass);
  for (int i = 0; i < M; i++)
    data->inverse_mass[i] = 1 / data->inverse_mass[i];
#elif defined(ROTATING_BODIES)
  number rates[3 * BODIES];
  turning(NULL, step->t, step->parameters, rates);
  for (int k = 0; k < BODIES; k++)
    data->bodies[k] = sorted_axes(BODY[k] + 1, rates + 3 * k);
#else
  data->unused = 0;
#endif
}

#include "leap.h"

#ifndef LANES
#ifdef DRIVEN_FORCES
/* Returns whether the inputs are those of the last step, after which they may jump, and keeps them. */
static int keep_inputs(const step_data *step, real *kept)
{
  int same = 1;
  for (int i = 0; i < DRIVING_INPUTS; i++, kept += 5) {
    same &= !memcmp(kept, step->parameters + DRIVING_INPUT[i], 5 * sizeof(real));
    memcpy(kept, step->parameters + DRIVING_INPUT[i], 5 * sizeof(real));
  }
  return same;
}
#endif

/* Computes the increments of one step; memory contains the last force, which the next step reuses if it starts with a
 * kick, unless inputs have changed, and the inputs last. */
SPLITTING int solve(const step_data *step, const solver_data *data, real *memory, long long *guess, real *dq, real *dp,
    const solver_options *options, solver_report *report, real *workspace)
{
  real F[M], acted[2];
  memcpy(F, memory, sizeof F);
#ifdef RUN_ACTION
  acted[0] = memory[M];
#endif
#ifdef DRIVEN_FORCES
  if (!keep_inputs(step, memory + MEMORY - 5 * DRIVING_INPUTS))
    *guess = 0;
#endif
  leap(step, data, *guess > 0, F, dq, dp, acted);
  report->iterations++;
  TRY(reaches(step, dq, dp) ? OK : NOT_FINITE);
  memcpy(memory, F, sizeof F);
#ifdef RUN_ACTION
  memory[M] = acted[0], memory[M + 1] = acted[1];
#endif
  *guess = 1;
  return OK;
}
#else
typedef solver_data iteration_data;

#define prepare_iteration prepare

/* Computes the increments of one step of each trajectory; the last step has stored its last force. */
static inline void fixed_point(const step_data *step, const iteration_data *data, history past, long long *guess,
    lanes *dq, lanes *dp, const solver_options *options, solver_report *report)
{
  number acted[2];
  memcpy(past.before[0], past.last[0], sizeof(lanes) * M);
  leap(step, data, *guess > 0, past.before[0], dq, dp, acted);
  report->iterations++;
  *guess = 1;
}
#endif
