/* A step by sweeps for any Hamiltonian. Before it: one_trajectory.h, point_weights.h, the tables, the kernels
 * velocity_lanes and force_lanes. */

/* Positions at the points of the curve whose velocities are z. */
static inline void place(const step_data *step, const sweep_data *data, lanes (*z)[M], lanes *u)
{
  lanes scaled[GROUPS][M];
  scale(data->position_weight, z, scaled);
  for (int i = 0; i < M; i++)
    u[i] = step->q0[i] + (step->carry_q[i] + apply(POSITION, 0, scaled, i));
}

/* Momenta there from the forces. */
static inline void push(const step_data *step, const sweep_data *data, lanes (*force)[M], lanes *u)
{
  lanes scaled[GROUPS][M];
  scale(data->momentum_weight, force, scaled);
  for (int i = 0; i < M; i++)
    u[M + i] = step->p0[i] + (step->carry_p[i] + apply(MOMENTUM, 0, scaled, i));
}

/* 1 / the size of x at both ends of the step, which makes its changes relative, or `absolute`. */
static inline void measure_ends(const lanes *x, const solver_options *options, double absolute, double *inverse_size)
{
  for (int i = 0; i < M; i++) {
    const lane_view view = {x[i]};
    inverse_size[i] = fabs(view.lane[0]) + fabs(view.lane[LANES - 1]);
  }
  invert_sizes(options, absolute, inverse_size);
}

/* The increments of one step. Forces, momenta and velocities follow each other until momenta and velocities rest; the
 * increments are made from the forces where they do. Velocities and forces are kept. */
HOT int sweep(const step_data *step, const sweep_data *data, history past, long long *steps, double *dq, double *dp,
    const solver_options *options, solver_report *report)
{
  const lanes at_points = step->t + step->h * ABSCISSA[0];
  lanes z[GROUPS][M], force[GROUPS][M], u[2 * M], value[M];
  double velocity_size[M], momentum_size[M];
  progress now = before_sweeps();
  int status = OK;
  if (*steps > 0) {
    continue_curve(step, past, *steps, z);
    continue_curve(step, past + 2 * M * LANES, *steps, force);
  } else {
    status = start_velocities(step, z);
    for (int i = 0; i < M; i++)
      force[0][i] = lanes_of(0.0);
  }
  if (status != OK)
    return status;
  push(step, data, force, u);
  for (int k = 0; needs_sweep(&now); k++) {
    lanes change = lanes_of(0.0), before[M];
    memcpy(before, u + M, sizeof before);
    place(step, data, z, u);
    force_lanes(u, at_points, step->parameters, force[0]);
    push(step, data, force, u);
    velocity_lanes(u, at_points, step->parameters, value);
    if (k == 0) {
      measure_ends(value, options, fabs(step->h), velocity_size);
      measure_ends(u + M, options, 1.0, momentum_size);
    }
    for (int i = 0; i < M; i++) {
      const lanes moved = (value[i] - z[0][i]) * velocity_size[i], pushed = (u[M + i] - before[i]) * momentum_size[i];
      change += moved * moved + pushed * pushed;
      z[0][i] = value[i];
    }
    take_change(&now, total_change(change), options, k, report);
  }
  status = outcome(&now, report);
  if (status != OK)
    return status;
  place(step, data, z, u);
  force_lanes(u, at_points, step->parameters, force[0]);
  for (int i = 0; i < M; i++) {
    dq[i] = lanes_total(POINT_END_POSITION[0] * (data->position_weight[0] * z[0][i]));
    dp[i] = lanes_total(POINT_END_MOMENTUM[0] * (data->momentum_weight[0] * force[0][i]));
  }
  if (!accept(step, dq, dp, report))
    return NOT_FINITE;
  remember_curve(z, past);
  remember_curve(force, past + 2 * M * LANES);
  *steps = next_guess(*steps, &now, report);
  return OK;
}
