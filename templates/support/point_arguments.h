/* Arguments of forces and momenta. Requires: points.h or trajectories.h, the tables; PROJECTED if the unknowns are not
 * the velocities at the points. */

/* Positions and velocities at point n of the curve with coefficients z. */
static inline void place(const step_data *step, int n, lanes (*scaled)[M], lanes (*z)[M], lanes *u)
{
  for (int i = 0; i < M; i++) {
    u[i] = step->q0[i] + (step->carry_q[i] + apply(POSITION, n, scaled, i));
#ifdef PROJECTED
    u[M + i] = apply(VELOCITY, n, z, i);
#else
    u[M + i] = z[n][i];
#endif
  }
}
