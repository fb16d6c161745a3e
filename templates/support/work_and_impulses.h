/* Work and impulse of the generalised forces in one step: the change of the energy, and of the momentum maps. Requires:
 * newton_from_line.h, and sums_along, which integrates along the curve z. */

SELDOM int NAME(work_and_impulses)(real t, real h, const real *q0, const real *p0, const real *parameters,
    const solver_options *options, real *q1, real *p1, real *given, solver_report *report, real *workspace)
{
  const solver_options standard = NAME(default_options)();
  const real carry[M] = {0};
  const newton_data data = newton_in(workspace + SCRATCH);
  const step_data step = {t, h, q0, p0, carry, carry, parameters, workspace, 1, NULL};
  solver_report unread;
  real dq[M], dp[2 * M] = {0};
  int keep = 0, status;
  report = report ? report : &unread;
  memset(report, 0, sizeof *report);
  report->t = t;
  status = newton_from_line(&step, &data, dp, &keep, options ? options : &standard, report);
  if (status != OK)
    return status;
  sums_along(&step, data.z, given);
  gather(END_POSITION, 1, h, data.z, M, dq, 0, 1);
  if (!all_finite(given, SUMS) || !reaches(&step, dq, dp))
    return NOT_FINITE;
  for (int i = 0; i < M; i++) {
    q1[i] = q0[i] + dq[i];
    p1[i] = p0[i] + (dp[i] + dp[M + i]);
  }
  report->steps = 1;
  return OK;
}
