#include "advance_to.h"

/* Adaptive runs on a GPU: a thread advances one trajectory. One whose step fails stops; the processor repeats it.
 * Requires: KERNEL, and TRAJECTORY, the number of the thread. */

/* Size of the memory of a run. */
KERNEL NAME(thread_size)(long long *size)
{
  *size = (long long)sizeof(run_memory);
}

/* Advances the trajectories `which` by at most `steps` steps; with `first` from t0 and the states in q, p. runs: their
 * memory between calls; parameters: (count, P). t, q, p: of each its time, and its state if it is at t_end.
 * first_step: NaN for trials. status: of the step that failed, 0 at t_end, else -1. done: numbers of completed steps.
 * solver_tolerance: 0 for the one of `tolerance`. */
KERNEL NAME(thread_advance_to)(long long number, const long long *which, long long first, long long steps, double t0,
    const double *t_end, double tolerance, double max_step, double first_step,
    const double *absolute_tolerance, double solver_tolerance, long long max_iterations, long long absolute,
    run_memory *runs, const double *parameters, double *t, double *q, double *p, long long *status, long long *done)
{
  const long long k = TRAJECTORY, every = 0x7fffffffffffffffLL;
  const step_control control = {tolerance, max_step, first_step > 0.0 ? &first_step : NULL, absolute_tolerance};
  const solver_options options = {solver_tolerance, (int)max_iterations, (int)absolute};
  run_memory run;
  solver_report report;
  double end, workspace[WORKSPACE_OF_THREAD], own[P + 1];
  long long j;
  int result, iterations;
  if (k >= number)
    return;
  j = which[k];
  for (int i = 0; i < P; i++)
    own[i] = parameters[j * P + i];
  if (first)
    NAME(start)(&run, t0, 0.0, q + j * M, p + j * M);
  else
    run = runs[j];
  result = NAME(advance_to)(&run, t_end[j], &control, steps, every, own, solver_tolerance > 0.0 ? &options : NULL,
      &end, q + j * M, p + j * M, &iterations, &report, workspace);
  status[j] = result != OK ? result : has_arrived(run.t, run.t_low, t_end[j]) ? 0
                                                                              : -1;
  t[j] = run.t;
  done[j] = run.step;
  runs[j] = run;
}
