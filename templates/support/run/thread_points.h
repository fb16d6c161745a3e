#include "run.h"

/* Fixed steps on a GPU: POINT_THREADS threads advance one trajectory, each with one point of its steps; all have
 * its state. A trajectory whose step fails stops; the processor repeats it. Requires: KERNEL, TRAJECTORY, OWN_POINT. */

/* Size of the memory of a run. */
KERNEL NAME(thread_size)(long long *size)
{
  *size = (long long)sizeof(run_memory);
}

/* Advances `count` trajectories from step number `begin`, at 0 from the states q0, p0 at t0. runs: the memory of each
 * thread between calls; parameters: (count, P). Every `every` steps counted from the start states are stored in rows of
 * (count, M) numbers. done: number of completed steps of each trajectory. */
KERNEL NAME(thread_points)(long long count, long long begin, long long steps, long long every, double t0, double h,
    double tolerance, long long max_iterations, long long absolute, run_memory *runs, const double *q0,
    const double *p0, const double *parameters, double *q, double *p, long long *done)
{
  const long long thread = TRAJECTORY, k = thread / POINT_THREADS, end = begin + steps, never = 0x7fffffffffffffffLL;
  const solver_options options = {tolerance, (int)max_iterations, (int)absolute};
  run_memory run;
  solver_report report;
  double workspace[WORKSPACE_OF_THREAD], own[P + 1];
  if (k >= count || done[k] < begin)
    return;
  for (int i = 0; i < P; i++)
    own[i] = parameters[k * P + i];
  if (begin > 0)
    run = runs[thread];
  else
    NAME(start)(&run, t0, h, q0 + k * M, p0 + k * M);
  for (q += k * M, p += k * M; run.step < end;) {
    const long long left = every - run.step % every, next = left < end - run.step ? left : end - run.step;
    if (NAME(advance)(&run, next, never, own, &options, NULL, NULL, NULL, NULL, &report, workspace) != OK)
      break;
    if (run.step % every == 0) {
      for (int i = 0; i < M && OWN_POINT == 0; i++) {
        q[i] = run.q[i];
        p[i] = run.p[i];
      }
      q += count * M;
      p += count * M;
    }
  }
  if (OWN_POINT == 0)
    done[k] = run.step;
  runs[thread] = run;
}
