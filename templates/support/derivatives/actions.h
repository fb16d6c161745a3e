#include "../newton/newton_from_line.h"

/* Actions of steps from given states: h sum_n w_n L along the curve of each step, without forces and constraints.
 * Requires: newton_from_line.h, sums_along. */

int NAME(actions)(long long steps, const real *t, const real *h, const real *q, const real *p, const real *parameters,
    long long stride, const solver_options *options, real *q1, real *p1, real *action, solver_report *report,
    real *workspace)
{
  const solver_options standard = NAME(default_options)();
  const real carry[M] = {0};
  newton_data *data = newton_in(workspace + SCRATCH);
  memset(report, 0, sizeof *report);
  for (long long k = 0; k < steps; k++) {
    const step_data step = step_from(t[k], h[k], q + k * M, p + k * M, carry, carry, parameters + k * stride, workspace);
    real dq[M], dp[2 * M] = {0}, sums[SUMS];
    int keep = 0, status = newton_from_line(&step, data, dp, &keep, options ? options : &standard, report);
    report->t = t[k];
    if (status != OK)
      return status;
    gather(END_POSITION, 1, step.h, data->z, M, dq, 0, 1);
    for (int i = 0; i < M; i++) {
      q1[k * M + i] = step.q0[i] + dq[i];
      p1[k * M + i] = step.p0[i] + (dp[i] + dp[M + i]);
    }
    sums_along(&step, data->z, sums);
    action[k] = sums[SUMS - 1];
    if (!all_finite(action + k, 1) || !all_finite(q1 + k * M, M) || !all_finite(p1 + k * M, M))
      return NOT_FINITE;
    report->steps++;
  }
  return OK;
}
