/* Discrete Lagrangian of an explicit method (EXPLICIT_STEPS) or of an implicit one (DISCRETE_LAGRANGIAN), with its
 * Legendre transforms; otherwise work and impulses of the forces of a step. */

#if defined(EXPLICIT_STEPS)
/* Discrete Lagrangian of the kick-drift-kick scheme (Stoermer-Verlet) and its discrete Legendre transforms. The drift
 * has the velocity (q1 - q0) / h, so that no equations are solved. Requires: splitting.h, energy. */
int NAME(discrete_legendre)(real t, real h, const real *q0, const real *q1, const real *parameters,
    const solver_options *options, real *p0, real *p1, real *action, solver_report *report, real *workspace)
{
  const real *ends[2] = {q0, q1};
  real p[M], F[2][M], product = 0, sum = 0, energy;
  if (report)
    memset(report, 0, sizeof *report);
  mass(NULL, t, parameters, p);
  for (int i = 0; i < M; i++) {
    const real v = (q1[i] - q0[i]) / h;
    p[i] *= v;
    product += p[i] * v;
  }
  for (int n = 0; n < 2; n++) {
    const real then = t + KICK_ABSCISSA[n] * h;
    TRY(NAME(energy)(then, ends[n], p, parameters, &energy, workspace));
    force(ends[n], then, parameters, F[n]);
    sum += KICK[n] * (product - energy);
  }
  for (int i = 0; i < M; i++) {
    p0[i] = p[i] - h * KICK[0] * F[0][i];
    p1[i] = p[i] + h * KICK[1] * F[1][i];
  }
  *action = h * sum;
  return all_finite(p0, M) && all_finite(p1, M) && all_finite(action, 1) ? OK : NOT_FINITE;
}
#elif defined(DISCRETE_LAGRANGIAN)
#include "../newton/newton_between.h"

/* Discrete Lagrangian L_d(q0, q1) and its discrete Legendre transforms p0 = -D1 L_d, p1 = D2 L_d (Marsden & West, Acta
 * Numerica 2001, sec. 1.3). On failure p0, p1 and the action are undefined. Requires: sums_along, which sums the
 * Lagrangian along the curve z. */

SELDOM int NAME(discrete_legendre)(real t, real h, const real *q0, const real *q1, const real *parameters,
    const solver_options *options, real *p0, real *p1, real *action, solver_report *report, real *workspace)
{
  const real carry_q[M] = {0};
  solver_report unread;
  newton_data *data = newton_in(workspace + SCRATCH);
  real start_p[M], increment[M];
  const step_data step = step_from(t, h, q0, start_p, carry_q, carry_q, parameters, workspace);
  report = report ? report : &unread;
  memset(report, 0, sizeof *report);
  TRY(newton_between(&step, data, q1, start_p, increment, options ? options : &STANDARD_OPTIONS, report));
  for (int i = 0; i < M; i++) {
    p0[i] = start_p[i];
    p1[i] = start_p[i] + increment[i];
  }
  sums_along(&step, data->z, action);
  return OK;
}
#else
/* Work and impulse of the generalised forces in one step: the change of the energy, and of the momentum maps. Requires:
 * newton_from_line.h, and sums_along, which integrates along the curve z. */

SELDOM int NAME(work_and_impulses)(real t, real h, const real *q0, const real *p0, const real *parameters,
    const solver_options *options, real *q1, real *p1, real *given, solver_report *report, real *workspace)
{
  const real carry[M] = {0};
  newton_data *data = newton_in(workspace + SCRATCH);
  const step_data step = step_from(t, h, q0, p0, carry, carry, parameters, workspace);
  solver_report unread;
  real dq[M], dp[2 * M] = {0};
  int keep = 0;
  report = report ? report : &unread;
  memset(report, 0, sizeof *report);
  report->t = t;
  TRY(newton_from_line(&step, data, dp, &keep, options ? options : &STANDARD_OPTIONS, report));
  sums_along(&step, data->z, given);
  gather(END_POSITION, 1, h, data->z, M, dq, 0, 1);
  TRY(all_finite(given, SUMS) && reaches(&step, dq, dp) ? OK : NOT_FINITE);
  for (int i = 0; i < M; i++) {
    q1[i] = q0[i] + dq[i];
    p1[i] = p0[i] + (dp[i] + dp[M + i]);
  }
  report->steps = 1;
  return OK;
}
#endif
