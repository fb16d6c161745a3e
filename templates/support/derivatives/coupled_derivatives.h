#include "../iteration/mass_matrix.h"
#include "../iteration/one_trajectory.h"
#include "../iteration/point_weights.h"
#include "jvp_and_vjp.h"
#include "vector_convergence.h"

/* Derivatives of a step solved by coupled_iteration.h and their transpose, by fixed-point iteration. With the tables A
 * (positions from velocities) and W (momenta from forces), the variations x, v, f, p of positions, velocities, forces
 * and momenta at the points satisfy
 *   x = x0 + h A v,        f = L_qq x + L_qv v,        p = p0 + h W f,        v = L_vv^-1 (p - L_vq x),
 * and the adjoint variables y, z, w of f, x, p satisfy the transposed equations
 *   y = y0 + h W^T w,      z = L_qq y - L_qv w,        v = v0 + h A^T z,      w = L_vv^-1 (v + L_vq y).
 * The derivatives are those of the exact solution of the stage equations. Requires: coupled_iteration.h;
 * CHANGE_POSITION (A), CHANGE_MOMENTUM (W) and their transposes with _BACK; the kernels point_derivatives,
 * derivative_product, TRANSPOSED_PRODUCT; POINT_INPUTS and input_derivatives. */

enum { STORED_OF_STEP = M * (POINTS + 2) }; /* numbers: velocities, then the increments of q and p */

/* Linearisation of a solved step: its increments, displacements D, E of the points from (q0, p0), x and v followed by
 * the derivatives of forces and momenta with respect to them, derivatives with respect to parameters and time, of
 * momenta times -1, and factors of the mass matrices. */
typedef struct {
  const step_data *step;
  const double *dq, *dp;
  lanes D[GROUPS][M], E[GROUPS][M], u[GROUPS][2 * M + POINT_DERIVATIVES], given[GROUPS][INPUT_DERIVATIVES],
      mass[GROUPS][MASS];
  weight end_position[GROUPS], end_momentum[GROUPS];
  double accepted; /* squared: relative change of vectors still to come that is accepted */
} iterated_step;

/* Stores the velocities and increments of a step, from which linearise_points linearises it. */
static void store_step(const step_data *step, const iteration_data *data, const double *memory, const double *dq,
    const double *dp, double *to)
{
  memcpy(to, memory, sizeof(double) * M * POINTS);
  memcpy(to + M * POINTS, dq, sizeof(double) * M);
  memcpy(to + M * (POINTS + 1), dp, sizeof(double) * M);
}

static __attribute__((noinline)) void linearise_points(const step_data *step, const iteration_data *data,
    const double *stored, iterated_step *at)
{
  lanes V[GROUPS][M], value[M + POINT_DERIVATIVES];
  at->step = step;
  at->dq = stored + M * POINTS;
  at->dp = at->dq + M;
  lanes_load(stored, V);
  for (int n = 0; n < GROUPS; n++) {
    const lanes t = step->t + step->h * ABSCISSA[n];
    lanes u[2 * M];
    at->end_position[n] = POINT_END_POSITION[n] * data->position_weight[n];
    at->end_momentum[n] = POINT_END_MOMENTUM[n] * data->momentum_weight[n];
    for (int i = 0; i < M; i++) {
      at->D[n][i] = step->h * apply(CHANGE_POSITION, n, V, i);
      u[i] = step->q0[i] + at->D[n][i];
      u[M + i] = V[n][i];
    }
    memset(at->mass[n], 0, sizeof at->mass[n]);
    point_derivatives(u, t, step->parameters, value, at->mass[n]);
    factor_mass(at->mass[n]);
    for (int i = 0; i < M; i++)
      at->E[n][i] = value[i] - step->p0[i];
    memcpy(at->u[n] + 2 * M, value + M, sizeof(lanes) * POINT_DERIVATIVES);
    input_derivatives(u, t, step->parameters, at->given[n]);
    for (int e = 0; e < INPUT_DERIVATIVES; e++)
      at->given[n][e] = POINT_INPUTS[e][0] < M ? at->given[n][e] : -at->given[n][e];
  }
}

/* Computes the variations of positions from those of velocities v and from x0 (back: adjoints of forces from those of
 * momenta), then the terms f and part of p that follow from both. */
static inline void vary_positions(iterated_step *at, int back, lanes (*x0)[M], lanes (*v)[M], lanes (*f)[2 * M])
{
  const step_data *step = at->step;
  const lanes *table = back ? CHANGE_MOMENTUM_BACK : CHANGE_POSITION;
  for (int n = 0; n < GROUPS; n++) {
    for (int i = 0; i < M; i++)
      at->u[n][i] = x0[n][i] + step->h * apply(table, n, v, i);
    memcpy(at->u[n] + M, v[n], sizeof v[n]);
    (back ? TRANSPOSED_PRODUCT : derivative_product)(at->u[n], lanes_of(step->t), step->parameters, f[n]);
  }
}

/* Solves for f and v from the initial terms x0 and p0 (back: z and w from y0 and v0); leaves x and v (y and w) in u,
 * and f. The change is measured in the metric of the mass matrices, independent of the units of the coordinates. */
static inline int solve_vectors(iterated_step *at, int back, lanes (*x0)[M], lanes (*p0)[M], lanes (*f)[2 * M],
    int *look)
{
  const lanes *table = back ? CHANGE_POSITION_BACK : CHANGE_MOMENTUM;
  lanes v[GROUPS][M], F[GROUPS][M], p[GROUPS][M];
  vector_changes past = {INFINITY, INFINITY, at->accepted};
  int status = 0;
  memset(v, 0, sizeof v);
  memset(p, 0, sizeof p);
  vary_positions(at, back, x0, v, f);
  for (int k = 0; status == 0; k++) {
    lanes moved[GROUPS], size[GROUPS];
    for (int n = 0; n < GROUPS; n++)
      memcpy(F[n], f[n], sizeof F[n]);
    for (int n = 0; n < GROUPS; n++) {
      lanes next[M], before[M];
      moved[n] = size[n] = lanes_of(0.0);
      memcpy(before, p[n], sizeof before);
      for (int i = 0; i < M; i++)
        next[i] = p[n][i] = p0[n][i] + at->step->h * apply(table, n, F, i) + f[n][M + i];
      solve_mass(at->mass[n], next);
      for (int i = 0; i < M; i++) {
        moved[n] += (p[n][i] - before[i]) * (next[i] - v[n][i]);
        size[n] += p[n][i] * next[i];
        v[n][i] = next[i];
      }
    }
    if (k >= *look)
      status = vectors_status(fabs(points_total(moved)), fabs(points_total(size)), &past, k, look);
    vary_positions(at, back, x0, v, f);
  }
  return status == 1 ? OK : NOT_CONVERGED;
}

/* Replaces v, variations of (q0, p0, parameters, t, h), by those of (q1, p1, parameters, t + h, h) (JVP). */
static __attribute__((noinline)) int jvp_by_iteration(iterated_step *at, double *v, int *look)
{
  const double h = at->step->h, dh = v[INPUT_T + 1] / h;
  lanes given[GROUPS][2 * M], x0[GROUPS][M], p0[GROUPS][M], f[GROUPS][2 * M], F[GROUPS][M];
  vary_by_inputs(at->given, v, given[0], 2 * M);
  for (int n = 0; n < GROUPS; n++)
    memcpy(F[n], given[n], sizeof F[n]);
  for (int n = 0; n < GROUPS; n++)
    for (int i = 0; i < M; i++) {
      x0[n][i] = v[i] + dh * at->D[n][i];
      p0[n][i] = v[M + i] + dh * at->E[n][i] + h * apply(CHANGE_MOMENTUM, n, F, i) + given[n][M + i];
    }
  TRY(solve_vectors(at, 0, x0, p0, f, look));
  for (int i = 0; i < M; i++) {
    lanes moved[GROUPS], pushed[GROUPS];
    for (int n = 0; n < GROUPS; n++) {
      moved[n] = at->end_position[n] * at->u[n][M + i];
      pushed[n] = at->end_momentum[n] * (f[n][i] + given[n][i]);
    }
    v[i] += dh * at->dq[i] + points_total(moved);
    v[M + i] += dh * at->dp[i] + points_total(pushed);
  }
  v[INPUT_T] += v[INPUT_T + 1];
  return OK;
}

/* Replaces v, adjoint variables of (q1, p1, parameters, t + h, h), by those of (q0, p0, parameters, t, h) (VJP). */
static __attribute__((noinline)) int vjp_by_iteration(iterated_step *at, double *v, int *look)
{
  double by_h = 0.0;
  lanes y0[GROUPS][M], v0[GROUPS][M], z[GROUPS][2 * M];
  for (int n = 0; n < GROUPS; n++)
    for (int i = 0; i < M; i++) {
      y0[n][i] = at->end_momentum[n] * v[M + i];
      v0[n][i] = at->end_position[n] * v[i];
    }
  TRY(solve_vectors(at, 1, y0, v0, z, look));
  v[INPUT_T + 1] += v[INPUT_T];
  add_input_gradient(at->given, at->u[0], 2 * M + POINT_DERIVATIVES, v);
  for (int i = 0; i < M; i++) {
    lanes placed[GROUPS], pushed[GROUPS], grown[GROUPS];
    for (int n = 0; n < GROUPS; n++) {
      placed[n] = z[n][i];
      pushed[n] = at->u[n][M + i];
      grown[n] = z[n][i] * at->D[n][i] + at->u[n][M + i] * at->E[n][i];
    }
    by_h += v[i] * at->dq[i] + v[M + i] * at->dp[i] + points_total(grown);
    v[i] += points_total(placed);
    v[M + i] += points_total(pushed);
  }
  v[INPUT_T + 1] += by_h / at->step->h;
  return OK;
}
