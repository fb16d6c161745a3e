#include "../run/run.h"

/* Reversible step-size control by an integrated step density; HAMILTONIAN_SYSTEM: the density depends on momenta,
 * not on velocities. */
/* Arguments of the step density, one word of each: positions, momenta or velocities. Requires: energies.h. */
static int density_arguments(const step_data *step, real *u)
{
  scalar moving[M];
  for (int i = 0; i < M; i++)
    moving[i] = SCALAR(step->p0[i]);
#ifndef HAMILTONIAN_SYSTEM
  scalar q[M], p[M];
  memcpy(p, moving, sizeof p);
  for (int i = 0; i < M; i++)
    q[i] = SCALAR(step->q0[i]);
  TRY(velocities_of(SCALAR(step->t), q, p, step->parameters, moving, step->scratch));
#endif
  for (int i = 0; i < M; i++)
    u[i] = step->q0[i], u[M + i] = HIGH_WORD(moving[i]);
  return OK;
}

/* Fixed steps tau in a transformed time dt = g dtau, h = tau / rho. The step density rho = 1/g is integrated by its own
 * equation drho/dtau = -d(log g)/dt from the middle of one step to that of the next, so that the step sequence is
 * time-reversible if the method is (integrating controller; Hairer & Soederlind, SIAM J. Sci. Comput. 26, 2005). A step
 * that ends at a prescribed time is a part of tau and advances the density by as much. Requires: run.h, prepare and
 * solve of a solver, the kernel step_density, (1/g, -d(log g)/dt). Include before advance_to.h. */

#define LAST_STEP REAL(1e-6) /* relative to the step: a step that ends so near t_end ends at t_end */

/* Data shared by the trials of a step. */
typedef struct {
  state at;
  step_data step;
  solver_data data;
  real t_end, tau, density, part, growth; /* growth: change of the density in half of a whole step */
  real dq[2 * M], dp[2 * M]; /* increments, then their low words */
  long long fallbacks; /* 1 if the fallback solved the step */
  int last; /* 1 if the step ends at t_end */
  int turned; /* 1 if the run reverses its direction */
#ifdef MIXED_POINTS
  POINTS_OF_STEP(points); /* of the step in double */
#endif
} trial;

static void begin_trials(run_memory *run, trial *now, const step_control *control, solver_options *standard)
{
  now->tau = control->tau;
  now->turned = (real)run->direction * ((now->t_end - run->t) - run->t_low) < 0;
}

/* Density in the middle of the next step, if it is a whole one; if the run reverses, of the previous one. */
static int next_density(const run_memory *run, trial *now)
{
  const real half = (real)run->direction * now->tau / 2, halves = now->turned ? 1 - run->part : 1 + run->part;
  real u[2 * M], value[2];
  TRY(density_arguments(&now->step, u));
  step_density(u, now->at.t, now->step.parameters, value);
  now->growth = half * value[1];
  now->density = run->density > 0 ? run->density + halves * now->growth : value[0] + now->growth;
  return now->density > 0 && is_finite(now->density) ? OK : NOT_FINITE;
}

/* Computes the increments of the next step. */
static int find_step(run_memory *run, trial *now, const solver_options *options, solver_report *report)
{
  const real rest = (now->t_end - now->at.t) - now->at.t_low;
  report->t = now->step.t = now->at.t;
  TRY(next_density(run, now));
  now->step.h = MATH(copysign)(now->tau / now->density, rest);
  now->last = MATH(fabs)(now->step.h) * (1 + LAST_STEP) >= MATH(fabs)(rest);
  now->part = 1;
  if (now->last) {
    now->step.h = rest;
    now->density = (now->density - now->growth) / (1 - MATH(fabs)(rest) / now->tau * now->growth);
    now->part = MATH(fabs)(rest) * now->density / now->tau;
  }
  prepare(&now->step, &now->data);
  run->guess = 0; /* the predictor belongs to another step size */
  now->fallbacks = report->fallback_steps;
  const int status = solve(&now->step, &now->data, run->memory, &run->guess, now->dq, now->dp, options, report,
      now->step.scratch + SCRATCH);
  now->fallbacks = report->fallback_steps - now->fallbacks;
  return status;
}

static int confirm_step(run_memory *run, trial *now, const solver_options *options, solver_report *report)
{
#ifdef NO_ERROR_ESTIMATE
  return OK;
#else
  return examine_error(run, &now->step, &now->data, now->dq, options, now->step.scratch + SCRATCH);
#endif
}

/* Adds the increments to the state. */
static void accept_trial(run_memory *run, trial *now)
{
  add_increments(now->at.q, now->at.carry_q, now->dq);
  add_increments(now->at.p, now->at.carry_p, now->dp);
  if (now->last) {
    now->at.t = now->t_end;
    now->at.t_low = 0;
  } else {
    add_compensated(&now->at.t, &now->at.t_low, now->step.h, 0);
  }
  run->fallback_steps += now->fallbacks;
  run->density = now->density;
  run->part = now->part;
  now->turned = 0;
  run->step++;
}
