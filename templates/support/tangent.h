/* The derivative of a step, exact: that of the map which the solved equations define. Before it: newton_from_line.h,
 * slopes_along, and change_rows, which gives the change of the rows with changes of q0 and of the unknowns. */

/* derivative: 2M x 2M, rows (q1, p1), columns (q0, p0). */
SELDOM int NAME(tangent)(real t, real h, const real *q0, const real *p0, const real *parameters,
    const solver_options *options, real *q1, real *p1, real *derivative, solver_report *report, real *workspace)
{
  const solver_options standard = NAME(default_options)();
  const real carry[M] = {0};
  const band shape = band_of(SITES, B);
  const newton_data data = newton_in(workspace + SCRATCH);
  const step_data step = {t, h, q0, p0, carry, carry, parameters, workspace, 1, NULL};
  real *slope = workspace + WORKSPACE, *dz = slope + SLOPES, *rows = dz + N;
  solver_report unread;
  real dq[M], dp[2 * M] = {0}, size_p[SITES], size_q[M];
  int keep = 0, status;
  report = report ? report : &unread;
  memset(report, 0, sizeof *report);
  report->t = t;
  status = newton_from_line(&step, &data, dp, &keep, options ? options : &standard, report);
  if (status != OK)
    return status;
  gather(END_POSITION, 1, h, data.z, M, dq, 0, 1);
  for (int i = 0; i < M; i++) {
    q1[i] = q0[i] + dq[i];
    p1[i] = p0[i] + (dp[i] + dp[M + i]);
  }
  evaluate(&step, data.z, data.rows, size_p, size_q, data.factors, &shape);
  if (!factorise(data.factors, &shape, data.pivot))
    return SINGULAR;
  slopes_along(&step, data.z, slope);
  for (int k = 0; k < 2 * M; k++) {
    real unit_q[M] = {0}, unit_p[M] = {0};
    (k < M ? unit_q : unit_p)[k % M] = 1;
    memset(dz, 0, sizeof(real) * N);
    memset(rows, 0, sizeof(real) * SITES * (B + 1));
    for (int i = 0; i < M; i++)
      for (int r = 0; r < B; r++)
        rows[i * (B + 1) + r] = MOMENTUM_ROW[r] * unit_p[i];
    change_rows(&step, slope, unit_q, dz, rows);
    for (int i = 0; i < SITES; i++)
      memcpy(data.update + PLACE[i] * B, rows + i * (B + 1), sizeof(real) * B);
    back_substitute(data.factors, &shape, data.pivot, data.update);
    for (int i = 0; i < SITES; i++)
      for (int b = 0; b < B; b++)
        dz[i * B + b] = -data.update[PLACE[i] * B + b];
    memset(rows, 0, sizeof(real) * SITES * (B + 1));
    change_rows(&step, slope, unit_q, dz, rows);
    gather(END_POSITION, 1, h, dz, M, dq, 0, 1);
    for (int i = 0; i < M; i++) {
      derivative[i * 2 * M + k] = unit_q[i] + dq[i];
      derivative[(M + i) * 2 * M + k] = unit_p[i] + rows[i * (B + 1) + B];
    }
  }
  report->steps = 1;
  return all_finite(derivative, 4 * M * M) && all_finite(q1, M) && all_finite(p1, M) ? OK : NOT_FINITE;
}
