#ifndef SUPPORT_DISCRETE_LEGENDRE_H
#define SUPPORT_DISCRETE_LEGENDRE_H

/* Discrete Lagrangian of an explicit method (EXPLICIT_STEPS) or of an implicit one (DISCRETE_LAGRANGIAN), with its
 * Legendre transforms; otherwise work and impulses of the forces of a step. */
/* Discrete Lagrangian L_d(q0, q1) and its discrete Legendre transforms p0 = -D1 L_d, p1 = D2 L_d (Marsden & West, Acta
 * Numerica 2001, sec. 1.3). On failure p0, p1 and the action are undefined. Requires: newton.h; sums_along, which sums
 * the Lagrangian along the curve z. */

SELDOM int NAME(discrete_legendre)(real t, real h, const real *q0, const real *q1, const real *parameters,
    const solver_options *options, real *p0, real *p1, real *action, solver_report *report, real *workspace)
{
  const solver_options standard = NAME(default_options)();
  const real carry_q[M] = {0};
  solver_report unread;
  newton_data *data = newton_in(workspace + SCRATCH);
  real v[M], start_p[M], increment[M];
  const step_data step = step_from(t, h, q0, start_p, carry_q, carry_q, parameters, workspace);
  int keep = 0, status;
  report = report ? report : &unread;
  memset(report, 0, sizeof *report);
  for (int i = 0; i < M; i++)
    v[i] = (q1[i] - q0[i]) / h;
  status = NAME(momentum)(t, q0, v, parameters, start_p, workspace);
  if (status == OK) {
    start_on_line(v, start_p, data->z);
    status = newton(&step, data, q1, start_p, increment, &keep, options ? options : &standard, report);
  }
  if (status != OK)
    return status;
  for (int i = 0; i < M; i++) {
    p0[i] = start_p[i];
    p1[i] = start_p[i] + increment[i];
  }
  sums_along(&step, data->z, action);
  return OK;
}

#endif
