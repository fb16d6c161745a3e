/* Integrals along a step solved by fixed-point iteration. Requires: hamiltonian_iteration.h, the kernel
 * integrand_lanes. */

/* Quadrature of the momenta at the converged velocities and forces, which `memory` contains. */
static inline void integrals_of_iteration(const step_data *step, const iteration_data *data, const double *memory,
    double *sum)
{
  lanes z[GROUPS][M], force[GROUPS][M], u[GROUPS][2 * M], value[INTEGRALS], part[INTEGRALS][GROUPS];
  lanes_load(memory, z);
  lanes_load(memory + 2 * M * POINTS, force);
  place(step, data, z, u);
  push(step, data, force, u);
  for (int n = 0; n < GROUPS; n++) {
    integrand_lanes(u[n], step->t + step->h * ABSCISSA[n], step->parameters, value);
    for (int k = 0; k < INTEGRALS; k++)
      part[k][n] = POINT_END_MOMENTUM[n] * (data->momentum_weight[n] * value[k]);
  }
  for (int k = 0; k < INTEGRALS; k++)
    sum[k] = points_total(part[k]);
}
