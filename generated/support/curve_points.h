/* Quadrature points on a collocation curve. Requires: curve.h, NODES, the tables POINT_POSITION, POINT_VELOCITY. */

/* Positions and velocities at the quadrature points. */
static inline void place_points(const step_data *step, const curve_data *curve, lanes *u)
{
  for (int i = 0; i < M; i++) {
    const lanes V = curve->v0[i] + apply_to(COLLOCATION, curve->z[0][i]);
    u[i] = step->q0[i] + (step->carry_q[i] + apply_to(POINT_POSITION, step->h * V));
    u[M + i] = apply_to(POINT_VELOCITY, V);
  }
}

/* v0 -= mass^-1 misfit, averaged over the nodes; returns the squared relative change. */
static inline double correct_velocity(const lanes *mass, const double *misfit, const double *inverse_size, double *v0)
{
  lanes r[M];
  double total = 0.0;
  for (int i = 0; i < M; i++)
    r[i] = lanes_of(misfit[i]);
  solve_mass(mass, r);
  for (int i = 0; i < M; i++) {
    const double correction = lanes_total(NODE_MASK * r[i]) / NODES, moved = correction * inverse_size[i];
    total += moved * moved;
    v0[i] -= correction;
  }
  return total;
}
