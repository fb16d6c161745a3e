/* Integrals along a step that sweeps solved. Before it: coupled_sweep.h, the kernel integrand_lanes. */

/* By the quadrature of the momenta, at the points where the velocities came to rest, which memory holds. */
static inline void integrals_of_sweep(const step_data *step, const sweep_data *data, const double *memory, double *sum)
{
  lanes z[GROUPS][M], scaled[GROUPS][M], u[2 * M], value[INTEGRALS];
  lanes_load(memory, z[0]);
  scale(data->position_weight, z, scaled);
  place(step, 0, scaled, z, u);
  integrand_lanes(u, step->t + step->h * ABSCISSA[0], step->parameters, value);
  for (int k = 0; k < INTEGRALS; k++)
    sum[k] = lanes_total(POINT_END_MOMENTUM[0] * (data->momentum_weight[0] * value[k]));
}
