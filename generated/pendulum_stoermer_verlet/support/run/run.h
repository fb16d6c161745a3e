#ifndef SUPPORT_RUN_H
#define SUPPORT_RUN_H

#include "../core/status_codes.h"
#include "../core/step.h"

/* Single steps and runs. TIME_TRANSFORMATION: h is a step in tau, and time an integral along the curve;
 * NO_ERROR_ESTIMATE: of methods without a curve. */
/* Error estimate of methods without a curve: none. */
static int observe_error(run_memory *run, step_data *step, const solver_data *data, const real *dq, const real *dp,
    const solver_options *options, real *workspace)
{
  step->first = 0;
  (void)run, (void)data, (void)dq, (void)dp, (void)options, (void)workspace;
  return OK;
}

real NAME(step_error)(const run_memory *run)
{
  (void)run;
  return -1;
}

/* Duration of a step without time transformation. Requires: a solver. */

/* Duration of the solved step. */
static inline real step_duration(const step_data *step, const solver_data *data, const real *memory, long long guess,
    real *workspace)
{
  (void)data, (void)memory, (void)guess, (void)workspace;
  return step->h;
}

/* Single steps, and runs of many steps with compensated sums (Hairer, Lubich & Wanner, Geometric Numerical Integration,
 * sec. VIII.5). A failed call leaves the state at the last completed step; outputs of the failed step are undefined.
 * Requires: step.h, numbers.h, prepare and solve of a solver, which compute the increments of a step to a finite state,
 * step_duration, and observe_error. */

solver_options NAME(default_options)(void)
{
  const solver_options options = {.tolerance = TOLERANCE, .max_iterations = MAX_ITERATIONS};
  return options;
}

int NAME(step)(real t, real h, const real *q0, const real *p0, const real *parameters, const solver_options *options,
    real *q1, real *p1, solver_report *report, real *workspace)
{
  const solver_options standard = NAME(default_options)();
  const real nothing[M] = {0};
  const step_data step = step_from(t, h, q0, p0, nothing, nothing, parameters, workspace);
  solver_report unread;
  solver_data data;
  real *memory = workspace + SCRATCH, dq[2 * M] = {0}, dp[2 * M] = {0}; /* increments, then their low words */
  long long guess = 0;
  int status;
  report = report ? report : &unread;
  memset(report, 0, sizeof *report);
  report->t = t;
  prepare(&step, &data);
  status = solve(&step, &data, memory, &guess, dq, dp, options ? options : &standard, report, memory + MEMORY);
  if (status != OK)
    return status;
  report->duration = step_duration(&step, &data, memory, guess, memory + MEMORY);
  if (!is_finite(report->duration))
    return NOT_FINITE;
  report->steps = 1;
  for (int i = 0; i < M; i++) {
    q1[i] = q0[i] + (dq[i] + dq[M + i]);
    p1[i] = p0[i] + (dp[i] + dp[M + i]);
  }
  return OK;
}

void NAME(start)(run_memory *run, real t, real h, const real *q, const real *p)
{
  memset(run, 0, sizeof *run);
  run->t = t;
  run->h = h;
  memcpy(run->q, q, sizeof(real) * M);
  memcpy(run->p, p, sizeof(real) * M);
}

/* The part of the state that a step changes, in local memory during a call. */
typedef struct {
  real t, t_low, q[M], p[M], carry_q[M], carry_p[M];
} state;

static void load_state(const run_memory *run, state *now)
{
  now->t = run->t;
  now->t_low = run->t_low;
  memcpy(now->q, run->q, sizeof now->q);
  memcpy(now->p, run->p, sizeof now->p);
  memcpy(now->carry_q, run->carry_q, sizeof now->carry_q);
  memcpy(now->carry_p, run->carry_p, sizeof now->carry_p);
}

static void save_state(const state *now, run_memory *run)
{
  run->t = now->t;
  run->t_low = now->t_low;
  memcpy(run->q, now->q, sizeof now->q);
  memcpy(run->p, now->p, sizeof now->p);
  memcpy(run->carry_q, now->carry_q, sizeof now->carry_q);
  memcpy(run->carry_p, now->carry_p, sizeof now->carry_p);
}

/* Adds increments, whose low words follow them, to x. */
static void add_increments(real *x, real *carry, const real *increment)
{
  for (int i = 0; i < M; i++)
    add_compensated(&x[i], &carry[i], increment[i], increment[M + i]);
}

int NAME(advance)(run_memory *run, long long steps, long long every, const real *parameters,
    const solver_options *options, real *t, real *q, real *p, int *iterations, solver_report *report, real *workspace)
{
  const solver_options standard = NAME(default_options)();
  state now;
  step_data step = step_from(run->t, run->h, now.q, now.p, now.carry_q, now.carry_p, parameters, workspace);
  solver_report unread;
  solver_data data;
  long long stored = 0;
  real passed = 0, dq[2 * M] = {0}, dp[2 * M] = {0}; /* time; increments, then their low words */
  report = report ? report : &unread;
  memset(report, 0, sizeof *report);
  load_state(run, &now);
  prepare(&step, &data);
  for (long long k = 0; k < steps; k++) {
    const long long before = report->iterations;
    int status;
    report->t = step.t = now.t;
    status = solve(&step, &data, run->memory, &run->guess, dq, dp, options ? options : &standard, report,
        workspace + SCRATCH);
    if (status == OK)
      passed = step_duration(&step, &data, run->memory, run->guess, workspace + SCRATCH);
    if (status == OK && !is_finite(passed))
      status = NOT_FINITE;
    if (status == OK) {
      status = observe_error(run, &step, &data, dq, dp, options ? options : &standard, workspace + SCRATCH);
      run->guess = status == OK ? run->guess : 0;
    }
    if (status != OK) {
      save_state(&now, run);
      return status;
    }
    add_increments(now.q, now.carry_q, dq);
    add_increments(now.p, now.carry_p, dp);
    run->iterations += report->iterations - before;
    run->step++;
    add_compensated(&now.t, &now.t_low, passed, 0);
    report->steps++;
    if (run->step % every == 0) {
      t[stored] = now.t;
      memcpy(q + stored * M, now.q, sizeof(real) * M);
      memcpy(p + stored * M, now.p, sizeof(real) * M);
      iterations[stored] = (int)run->iterations;
      run->iterations = 0;
      stored++;
    }
  }
  report->duration = passed;
  save_state(&now, run);
  return OK;
}

#endif
