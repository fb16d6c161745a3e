#ifndef SUPPORT_FALLBACK_H
#define SUPPORT_FALLBACK_H

/* Solver of steps whose fixed-point iteration fails: none (NO_FALLBACK) or Newton's method. */
#ifdef NO_FALLBACK
/* No fallback: if the fixed-point iteration fails, the step fails. */
static int fall_back(int status, const step_data *step, double *dq, double *dp, const solver_options *options,
    solver_report *report, double *workspace)
{
  (void)step, (void)dq, (void)dp, (void)options, (void)report, (void)workspace;
  return status;
}
#else
#include "../newton/newton_from_line.h"

/* Fallback to Newton's method when the fixed-point iteration fails. */

static SELDOM int fall_back(int status, const step_data *step, double *dq, double *dp, const solver_options *options,
    solver_report *report, double *workspace)
{
  const newton_data newtons = newton_in(workspace);
  const long long before = report->iterations;
  int keep;
  status = newton_from_line(step, &newtons, dp, &keep, options, report);
  gather(END_POSITION, 1, step->h, newtons.z, M, dq, 0, 1);
  memset(dq + M, 0, sizeof(double) * M);
  memset(dp + M, 0, sizeof(double) * M);
  if (status == OK && is_spurious(step, newtons.z, dq, report->iterations - before))
    return STATUS(SPURIOUS_SOLUTION);
  return status;
}
#endif

#endif
