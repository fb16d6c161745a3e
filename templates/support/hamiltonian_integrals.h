/* Integrals along a step that sweeps solved. Before it: hamiltonian_sweep.h, the kernel integrand_lanes. */

/* By the quadrature of the momenta, at the points where velocities and forces came to rest, which memory holds. */
static inline void integrals_of_sweep(const step_data *step, const sweep_data *data, const double *memory, double *sum)
{
  lanes z[GROUPS][M], force[GROUPS][M], u[2 * M], value[INTEGRALS];
  lanes_load(memory, z[0]);
  lanes_load(memory + 2 * M * LANES, force[0]);
  place(step, data, z, u);
  push(step, data, force, u);
  integrand_lanes(u, step->t + step->h * ABSCISSA[0], step->parameters, value);
  for (int k = 0; k < INTEGRALS; k++)
    sum[k] = lanes_total(POINT_END_MOMENTUM[0] * (data->momentum_weight[0] * value[k]));
}
