/* Step of a collocation method by fixed-point iteration. Requires: curve.h, the momenta at the ends of a curve, the
 * table NODE_TIME, the kernel applied_force_lanes. */

/* Computes the increments of one step. Each iteration corrects the accelerations at the nodes and, where it is unknown,
 * the initial velocity. On failure the increments are undefined. */
HOT int fixed_point(const step_data *step, const iteration_data *data, history past, long long *steps, double *dq,
    double *dp,
    const solver_options *options, solver_report *report)
{
  curve_data curve;
  lanes u[2 * M], force[M], mass[MASS];
  double inverse_size[M] = {0.0};
  progress now = before_iterations();
  int status = first_curve(step, past, *steps, &curve);
  if (status != OK)
    return status;
  for (int k = 0; needs_iteration(&now); k++) {
    lanes change = lanes_of(0.0);
    double total;
    place_nodes(step, &curve, u);
    if (!DIAGONAL)
      memset(mass, 0, sizeof mass);
    applied_force_lanes(u, step->t + step->h * NODE_TIME, step->parameters, force, mass);
    factor_mass(mass);
    solve_mass(mass, force);
    for (int i = 0; i < M; i++) {
      const lanes z = step->h * force[i];
      force[i] = z - curve.z[0][i];
      curve.z[0][i] = z;
    }
    if (k == 0)
      measure_curve(step, &curve, options, inverse_size);
    for (int i = 0; i < M; i++) {
      const lanes moved = force[i] * inverse_size[i];
      change += moved * moved;
    }
    total = lanes_total(change);
    total += correct_start(step, data, mass, inverse_size, &curve);
    take_change(&now, total, options, k, report);
  }
  status = outcome(&now, report);
  if (status != OK)
    return status;
  end_increment(step, &curve, dq);
  momentum_increment(step, data, &curve, dq, dp);
  if (!accept(step, dq, dp, report))
    return NOT_FINITE;
  save_curve(&curve, past);
  *steps = next_guess(*steps, &now, report);
  return OK;
}
