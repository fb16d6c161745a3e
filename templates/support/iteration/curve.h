#include "../core/status_codes.h"
#include "convergence.h"
#include "mass_matrix.h"
#include "one_trajectory.h"

/* Collocation curve of a step (Hairer, Lubich & Wanner, Geometric Numerical Integration, sec. II.1.2) from its initial
 * velocity v0 and z = h a, a the accelerations at the nodes, with A the table COLLOCATION:
 *   v_n = v0 + sum_j A_nj z_j,      q_n = q0 + h sum_j A_nj v_j.
 * v0 is known from p0 (HAMILTONIAN) or an unknown; with NODES there are quadrature points, too. */
#ifdef HAMILTONIAN
/* Initial velocity of a curve from p0. Requires: HAMILTONIAN, 1 for Hamiltonian systems. */
static int nearby_velocity(const step_data *step, double *v0)
{
  double u[2 * M];
  int status;
  if (HAMILTONIAN)
    return find_velocity(step->t, step->q0, step->p0, step->parameters, v0, step->scratch);
  memcpy(u, step->q0, sizeof(double) * M);
  memcpy(u + M, v0, sizeof(double) * M);
  status = invert_from(step->t, u, step->p0, step->parameters, step->scratch);
  memcpy(v0, u + M, sizeof(double) * M);
  return status;
}
#else
/* Initial velocity of a curve as an unknown; the end of the last curve is the initial guess. */
#define nearby_velocity(step, v0) OK
#endif

/* Requires: a mass, the tables COLLOCATION, NODE_END, NODE_MASK, whose column j multiplies node j. */
typedef struct {
  double v0[M];
  lanes z[1][M];
} curve_data;

enum { CURVE_MEMORY = 2 * M * LANES + M }; /* z of the last two steps, then v0 */

static void save_curve(curve_data *curve, history past)
{
  remember_curve(curve->z, past);
  memcpy(past + 2 * M * LANES, curve->v0, sizeof curve->v0);
}

static inline lanes apply_to(const lanes *table, lanes x)
{
  return contribution_of_points(table, 0, &x, 1);
}

/* v1 = v0 + sum b z. */
static inline double end_velocity(const curve_data *curve, int i)
{
  return curve->v0[i] + lanes_total(NODE_MASK * NODE_END * curve->z[0][i]);
}

/* Initial curve: extrapolation of the last steps, or a straight line. */
static int first_curve(const step_data *step, const double *past, long long steps, curve_data *curve)
{
  if (steps > 0) {
    lanes_load(past, curve->z);
    memcpy(curve->v0, past + 2 * M * LANES, sizeof curve->v0);
    for (int i = 0; i < M; i++)
      curve->v0[i] = end_velocity(curve, i);
    continue_curve(step, past, steps, curve->z);
    return nearby_velocity(step, curve->v0);
  }
  for (int i = 0; i < M; i++)
    curve->z[0][i] = lanes_of(0.0);
  return find_velocity(step->t, step->q0, step->p0, step->parameters, curve->v0, step->scratch);
}

/* 1 / (|v0| + |v1|), which makes changes of velocities relative. */
static inline void measure_curve(const step_data *step, const curve_data *curve, const solver_options *options,
    double *inverse_size)
{
  for (int i = 0; i < M; i++)
    inverse_size[i] = fabs(curve->v0[i]) + fabs(end_velocity(curve, i));
  invert_sizes(options, fabs(step->h), inverse_size);
}

/* Positions and velocities at the nodes. */
static inline void place_nodes(const step_data *step, const curve_data *curve, lanes *u)
{
  for (int i = 0; i < M; i++) {
    u[M + i] = curve->v0[i] + apply_to(COLLOCATION, curve->z[0][i]);
    u[i] = step->q0[i] + (step->carry_q[i] + apply_to(COLLOCATION, step->h * u[M + i]));
  }
}

/* q1 - q0. */
static inline void end_increment(const step_data *step, const curve_data *curve, double *dq)
{
  for (int i = 0; i < M; i++)
    dq[i] = lanes_total(NODE_MASK * NODE_END * (step->h * (curve->v0[i] + apply_to(COLLOCATION, curve->z[0][i]))));
}

#ifdef NODES
/* Quadrature points on a collocation curve. Requires: NODES, the tables POINT_POSITION, POINT_VELOCITY. */

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
#endif
