#include "../step_size/observed_error.h"
#include "arrays.h"

/* Runs of array systems whose steps are solved by iteration. Requires: prepare and solve of a solver,
 * observed_error.h. */

static step_data step_of(const run_memory *run, const problem *arrays, const work_arrays *work)
{
  step_data step = {.t = run->t, .h = run->h, .q0 = run->q, .p0 = run->p};
  step.carry_q = run->carry_q, step.carry_p = run->carry_p;
  step.run = run, step.arrays = arrays, step.work = work, step.n = work->n;
  return step;
}

/* Advances the state to the end of a solved step. */
static void continue_steps(run_memory *run, const step_data *step, const double *dq, const double *dp)
{
  const section own = own_part(step);
  for (long long i = own.first; i < own.end; i++) {
    add_compensated(&run->q[i], &run->carry_q[i], dq[i], dq[step->n + i]);
    add_compensated(&run->p[i], &run->carry_p[i], dp[i], 0.0);
  }
  run->turn = (run->turn + 1) % 3;
}

/* Performs a step of the same size as the previous one. */
static int perform_step(run_memory *run, const problem *arrays, const work_arrays *work, const solver_options *options,
    solver_report *report)
{
  step_data step = step_of(run, arrays, work);
  array_motion motion = {{0.0}, {0.0}};
  solver_data data;
  int status = OK;
  step.motion = &motion;
  prepare(&step, &data);
  TRY(solve(&step, &data, history_in(&step), &run->guess, work->dq, work->dp, options, report, NULL));
  if (run->error < INFINITY) /* else a partial step, of a search for events */
    status = observe_error(run, &step, &data, work->dq, options, NULL);
  if (status == OK)
    continue_steps(run, &step, work->dq, work->dp);
  else
    run->guess = 0;
  return status;
}
