#include "mixed_step.h"

/* Single steps and runs in pairs. Arrays of states are M high words, then M low words. A failed call leaves the state
 * at the last completed step. */

solver_options NAME(default_options)(void)
{
  const solver_options options = {.tolerance = TOLERANCE, .max_iterations = MAX_ITERATIONS};
  return options;
}

int NAME(step)(double t, double h, const double *q0, const double *p0, const double *parameters,
    const solver_options *options, double *q1, double *p1, solver_report *report, double *workspace)
{
  const solver_options standard = NAME(default_options)();
  const step_data step = step_from(t, h, q0, p0, q0 + M, p0 + M, parameters, workspace);
  double memory[MEMORY] = {0.0};
  solver_report unread;
  solver_data data;
  long long guess = 0;
  int status;
  report = report ? report : &unread;
  memset(report, 0, sizeof *report);
  report->t = t;
  prepare(&step, &data);
  status = solve_in_pairs(
      &step, 0.0, &data, memory, &guess, options ? options : &standard, report, workspace + SCRATCH, q1, p1);
  report->duration = h;
  report->steps = status == OK;
  return status;
}

void NAME(start)(run_memory *run, double t, double h, const double *q, const double *p)
{
  memset(run, 0, sizeof *run);
  run->t = t;
  run->h = h;
  memcpy(run->q, q, sizeof run->q);
  memcpy(run->p, p, sizeof run->p);
}

int NAME(advance)(run_memory *run, long long steps, long long every, const double *parameters,
    const solver_options *options, double *t, double *q, double *p, int *iterations, solver_report *report,
    double *workspace)
{
  const solver_options standard = NAME(default_options)();
  step_data step = step_from(run->t, run->h, run->q, run->p, run->q + M, run->p + M, parameters, workspace);
  solver_report unread;
  solver_data data;
  long long stored = 0;
  report = report ? report : &unread;
  memset(report, 0, sizeof *report);
  prepare(&step, &data);
  for (long long k = 0; k < steps; k++) {
    const long long before = report->iterations;
    double q1[2 * M], p1[2 * M];
    report->t = step.t = run->t;
    const int status = solve_in_pairs(&step, run->t_low, &data, run->memory, &run->guess,
        options ? options : &standard, report, workspace + SCRATCH, q1, p1);
    if (status != OK) {
      run->guess = 0;
      return status;
    }
    memcpy(run->q, q1, sizeof run->q);
    memcpy(run->p, p1, sizeof run->p);
    run->iterations += report->iterations - before;
    run->step++;
    add_compensated(&run->t, &run->t_low, run->h, 0.0);
    report->steps++;
    if (run->step % every == 0) {
      t[stored] = run->t;
      memcpy(q + stored * 2 * M, run->q, sizeof run->q);
      memcpy(p + stored * 2 * M, run->p, sizeof run->p);
      iterations[stored] = (int)run->iterations;
      run->iterations = 0;
      stored++;
    }
  }
  report->duration = run->h;
  return OK;
}
