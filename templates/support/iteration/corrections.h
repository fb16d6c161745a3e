#include "mass_matrix.h"
#include "point_weights.h"

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

#ifdef FOLLOWED
/* Velocity corrections from residual momenta r, with forces and momenta linearised in the correction. Requires: a mass.
 * */
enum { VALUES = 2 * M + 3 * M * M }; /* of point_lanes: forces, momenta; F_q, F_v, P_q by rows */

/* Product of a matrix row and x. */
static inline lanes row_times(const lanes *row, const lanes *x)
{
  lanes sum = row[0] * x[0];
  for (int j = 1; j < M; j++)
    sum += row[j] * x[j];
  return sum;
}

/* First-order changes of the forces, F, and of the momenta at fixed velocity, P, by velocity changes r. */
static inline void forces_follow(const iteration_data *data, lanes (*value)[VALUES], lanes (*r)[M], lanes (*F)[M],
    lanes (*P)[M])
{
  lanes scaled[GROUPS][M], moved[M];
  scale(data->position_weight, r, scaled);
  for (int n = 0; n < GROUPS; n++) {
    const lanes *F_q = value[n] + 2 * M, *F_v = F_q + M * M, *P_q = F_v + M * M;
    for (int i = 0; i < M; i++)
      moved[i] = apply(POSITION, n, scaled, i);
    for (int i = 0; i < M; i++) {
      F[n][i] = row_times(F_v + i * M, r[n]) + row_times(F_q + i * M, moved);
      P[n][i] = row_times(P_q + i * M, moved);
    }
  }
}

/* r = mass^-1 r at all points, then once more with the residual of the linearised equations: one iteration converges
 * like two without further evaluations. */
static inline void correct(const iteration_data *data, lanes (*value)[VALUES], lanes (*mass)[MASS], lanes (*r)[M])
{
  lanes first[GROUPS][M], force[GROUPS][M], impulse[GROUPS][M], momentum[GROUPS][M];
  memcpy(first, r, sizeof first);
  for (int n = 0; n < GROUPS; n++)
    solve_mass(mass[n], first[n]);
  forces_follow(data, value, first, force, momentum);
  scale(data->momentum_weight, force, impulse);
  for (int n = 0; n < GROUPS; n++) {
    for (int i = 0; i < M; i++)
      r[n][i] += apply(MOMENTUM, n, impulse, i) - momentum[n][i];
    solve_mass(mass[n], r[n]);
  }
}

/* Forces at the converged velocities z, linearised at the last correction r, which is small. */
static inline void converged_forces(const step_data *step, const iteration_data *data, lanes (*value)[VALUES],
    lanes (*z)[M], lanes (*r)[M], lanes (*F)[M])
{
  lanes momentum[GROUPS][M];
  forces_follow(data, value, r, F, momentum);
  for (int n = 0; n < GROUPS; n++)
    for (int i = 0; i < M; i++)
      F[n][i] += value[n][i];
}
#else
/* Velocity corrections mass^-1 r from residual momenta r, with forces and momenta frozen. Requires: a mass, the kernel
 * force_lanes. */
enum { VALUES = 2 * M }; /* of point_lanes: forces, momenta */

/* r = mass^-1 r at all points. */
static inline void correct(const iteration_data *data, lanes (*value)[VALUES], lanes (*mass)[MASS], lanes (*r)[M])
{
  for (int n = 0; n < GROUPS; n++)
    solve_mass(mass[n], r[n]);
}

/* Forces at the converged velocities z, after the last correction r. */
static inline void converged_forces(const step_data *step, const iteration_data *data, lanes (*value)[VALUES],
    lanes (*z)[M], lanes (*r)[M], lanes (*F)[M])
{
  lanes u[2 * M], scaled[GROUPS][M];
  scale(data->position_weight, z, scaled);
  for (int n = 0; n < GROUPS; n++) {
    place(step, n, scaled, z, u);
#ifdef FROZEN_MASS
    value_lanes(u, step->t + step->h * ABSCISSA[n], step->parameters, value[n]);
    memcpy(F[n], value[n], sizeof F[n]);
#else
    force_lanes(u, step->t + step->h * ABSCISSA[n], step->parameters, F[n]);
#endif
#ifdef DAMPED
    grow(&data->damping, n, M, F[n]);
#endif
  }
}
#endif
