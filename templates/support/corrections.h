/* Velocity corrections mass^-1 r from residual momenta r, with forces and momenta frozen. Requires: point_arguments.h,
 * point_weights.h, a mass, the kernel force_lanes. */
enum { VALUES = 2 * M }; /* of point_lanes: forces, momenta */

/* r = mass^-1 r at all points. */
static inline void correct(const iteration_data *data, lanes (*value)[VALUES], lanes (*mass)[MASS], lanes (*r)[M])
{
  (void)data, (void)value;
  for (int n = 0; n < GROUPS; n++)
    solve_mass(mass[n], r[n]);
}

/* Forces at the converged velocities z, after the last correction r. */
static inline void converged_forces(const step_data *step, const iteration_data *data, lanes (*value)[VALUES],
    lanes (*z)[M],
    lanes (*r)[M], lanes (*F)[M])
{
  lanes u[2 * M], scaled[GROUPS][M];
  (void)value, (void)r;
  scale(data->position_weight, z, scaled);
  for (int n = 0; n < GROUPS; n++) {
    place(step, n, scaled, z, u);
    force_lanes(u, step->t + step->h * ABSCISSA[n], step->parameters, F[n]);
#ifdef DAMPED
    grow(&data->damping, n, M, F[n]);
#endif
  }
}
