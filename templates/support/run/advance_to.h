#include "run.h"

/* Adaptive integration to a given time t_end.
 *
 * Stores every `every`-th state and the one at t_end if there are arrays for them, and returns after at most `steps`
 * steps. On failure the run is left at the last completed step and the status of the failed one is returned. Requires
 * a controller: trial, begin_trials, find_step, confirm_step, and accept_trial, which adds the increments to the
 * state. */

/* A run is at t_end only if no low word is left: beyond 2^53 step sizes t alone is t_end some steps too early. */
static inline int has_arrived(real t, real t_low, real t_end)
{
  return t == t_end && t_low == 0;
}

#ifdef DOUBLE_DOUBLE
/* What is left to t_end after the last step, whose size is rounded; 0 for other steps. */
static inline real rest_of_last(const trial *now)
{
  const real span = now->t_end - now->at.t, part = span - now->t_end;
  const real rest = (now->t_end - (span - part)) - (now->at.t + part);
  return now->last ? (span - now->step.h) + (rest - now->at.t_low) : 0;
}

#ifdef LEAST_UNRESOLVED
/* Smallest tolerance that a step of round-off meets and an error estimate in double resolves. */
double NAME(smallest_tolerance)(void)
{
  return larger(pow(LEAST_UNRESOLVED, ERROR_POWER), SMALLEST_TOLERANCE);
}
#endif
#endif

int NAME(advance_to)(run_memory *run, real t_end, const step_control *control, long long steps, long long every,
    const real *parameters, const solver_options *options, real *t, real *q, real *p, int *iterations,
    solver_report *report, real *workspace)
{
  solver_options standard = NAME(default_options)();
  solver_report unread;
  trial now = {.t_end = t_end};
  report = report ? report : &unread;
  memset(report, 0, sizeof *report);
  if (cannot_store(t, every))
    return STATUS(EVERY_BELOW_1);
  begin_trials(run, &now, control, &standard);
  run->direction = (t_end - run->t) - run->t_low < 0 ? -1 : 1;
  options = options ? options : &standard;
  now.step = step_from(run->t, 0, now.at.q, now.at.p, now.at.carry_q, now.at.carry_p, parameters, workspace);
#ifndef EXPLICIT_RUN
  now.step.motion_of = run;
#endif
  memcpy(&now.at, run, sizeof now.at);
#ifdef MIXED_POINTS
  now.step.points = (double *)&now.points;
#elif defined(ERROR_GROWTH)
  now.step.points = run->measures_growth ? (double *)&now.points : NULL;
#endif
  while (report->steps < steps && !has_arrived(now.at.t, now.at.t_low, t_end)) {
    const long long before = report->iterations;
    int status = find_step(run, &now, options, report);
    if (status == OK)
      status = confirm_step(run, &now, options, report);
#ifdef DOUBLE_DOUBLE
    real passed[2]; /* which only steps in transformed time need */
    if (status == OK)
      status = refine_increments(&now.step, run->memory, now.at.t_low, rest_of_last(&now), now.dq, now.dp, passed,
          now.step.scratch + SCRATCH);
#endif
    if (status != OK) {
      run->guess = 0;
      memcpy(run, &now.at, sizeof now.at);
      return status;
    }
    accept_trial(run, &now);
    run->iterations += report->iterations - before;
    report->steps++;
    if (t && (run->step % every == 0 || has_arrived(now.at.t, now.at.t_low, t_end)))
      store_row(run, &now.at, report->stored++, t, q, p, iterations);
  }
  memcpy(run, &now.at, sizeof now.at);
  return OK;
}
