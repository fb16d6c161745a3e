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
static inline void vary_positions(iterated_step *at, int back, int count, lanes (*x0)[GROUPS][M],
    lanes (*v)[GROUPS][M], lanes (*x)[GROUPS][M], lanes (*f)[GROUPS][2 * M])
{
  const step_data *step = at->step;
  const lanes *table = back ? CHANGE_MOMENTUM_BACK : CHANGE_POSITION;
  for (int j = 0; j < count; j++)
    for (int n = 0; n < GROUPS; n++) {
      for (int i = 0; i < M; i++)
        at->u[n][i] = x[j][n][i] = x0[j][n][i] + step->h * apply(table, n, v[j], i);
      memcpy(at->u[n] + M, v[j][n], sizeof v[j][n]);
      (back ? TRANSPOSED_PRODUCT : derivative_product)(at->u[n], lanes_of(step->t), step->parameters, f[j][n]);
    }
}

/* Solves for some f, x and v from the initial terms x0 and p0 (back: z, y and w from y0 and v0) together. Changes are
 * measured in the metric of the mass matrices, independent of the units of the coordinates. */
static inline __attribute__((always_inline)) int solve_vectors(iterated_step *at, int back, int count,
    lanes (*x0)[GROUPS][M], lanes (*p0)[GROUPS][M], lanes (*x)[GROUPS][M], lanes (*v)[GROUPS][M],
    lanes (*f)[GROUPS][2 * M], int *look)
{
  const lanes *table = back ? CHANGE_POSITION_BACK : CHANGE_MOMENTUM;
  lanes p[VECTORS_AT_ONCE][GROUPS][M];
  vector_changes past = {INFINITY, INFINITY, at->accepted};
  int status = 0;
  memset(v, 0, sizeof *v * (size_t)count);
  memset(p, 0, sizeof *p * (size_t)count);
  vary_positions(at, back, count, x0, v, x, f);
  for (int k = 0; status == 0; k++) {
    double largest[2] = {0.0, 0.0};
    for (int j = 0; j < count; j++) {
      lanes moved[GROUPS], size[GROUPS], F[GROUPS][M];
      for (int n = 0; n < GROUPS; n++)
        memcpy(F[n], f[j][n], sizeof F[n]);
      for (int n = 0; n < GROUPS; n++) {
        lanes next[M], before[M];
        moved[n] = size[n] = lanes_of(0.0);
        memcpy(before, p[j][n], sizeof before);
        for (int i = 0; i < M; i++)
          next[i] = p[j][n][i] = p0[j][n][i] + at->step->h * apply(table, n, F, i) + f[j][n][M + i];
        solve_mass(at->mass[n], next);
        for (int i = 0; i < M; i++) {
          moved[n] += (p[j][n][i] - before[i]) * (next[i] - v[j][n][i]);
          size[n] += p[j][n][i] * next[i];
          v[j][n][i] = next[i];
        }
      }
      if (k >= *look)
        keep_largest(fabs(points_total(moved)), fabs(points_total(size)), largest);
    }
    if (k >= *look)
      status = vectors_status(largest[0], largest[1], &past, k, look);
    vary_positions(at, back, count, x0, v, x, f);
  }
  return status == 1 ? OK : NOT_CONVERGED;
}

/* Replaces v, variations of (q0, p0, parameters, t, h), by those of (q1, p1, parameters, t + h, h) (JVP). */
static inline __attribute__((always_inline)) int vary_step(iterated_step *at, int count, double (*v)[STEP_INPUTS],
    int *look)
{
  const double h = at->step->h;
  lanes given[VECTORS_AT_ONCE][GROUPS][2 * M], x0[VECTORS_AT_ONCE][GROUPS][M], p0[VECTORS_AT_ONCE][GROUPS][M],
      x[VECTORS_AT_ONCE][GROUPS][M], velocity[VECTORS_AT_ONCE][GROUPS][M], f[VECTORS_AT_ONCE][GROUPS][2 * M];
  for (int j = 0; j < count; j++) {
    const double dh = v[j][INPUT_T + 1] / h;
    lanes F[GROUPS][M];
    vary_by_inputs(at->given, v[j], given[j][0], 2 * M);
    for (int n = 0; n < GROUPS; n++)
      memcpy(F[n], given[j][n], sizeof F[n]);
    for (int n = 0; n < GROUPS; n++)
      for (int i = 0; i < M; i++) {
        x0[j][n][i] = v[j][i] + dh * at->D[n][i];
        p0[j][n][i] = v[j][M + i] + dh * at->E[n][i] + h * apply(CHANGE_MOMENTUM, n, F, i) + given[j][n][M + i];
      }
  }
  TRY(solve_vectors(at, 0, count, x0, p0, x, velocity, f, look));
  for (int j = 0; j < count; j++) {
    const double dh = v[j][INPUT_T + 1] / h;
    for (int i = 0; i < M; i++) {
      lanes moved[GROUPS], pushed[GROUPS];
      for (int n = 0; n < GROUPS; n++) {
        moved[n] = at->end_position[n] * velocity[j][n][i];
        pushed[n] = at->end_momentum[n] * (f[j][n][i] + given[j][n][i]);
      }
      v[j][i] += dh * at->dq[i] + points_total(moved);
      v[j][M + i] += dh * at->dp[i] + points_total(pushed);
    }
    v[j][INPUT_T] += v[j][INPUT_T + 1];
  }
  return OK;
}

/* Replaces v, adjoint variables of (q1, p1, parameters, t + h, h), by those of (q0, p0, parameters, t, h) (VJP). */
static __attribute__((noinline)) int vjp_by_iteration(iterated_step *at, double *v, int *look)
{
  double by_h = 0.0;
  lanes y0[1][GROUPS][M], v0[1][GROUPS][M], y[1][GROUPS][M], w[1][GROUPS][M], z[1][GROUPS][2 * M];
  for (int n = 0; n < GROUPS; n++)
    for (int i = 0; i < M; i++) {
      y0[0][n][i] = at->end_momentum[n] * v[M + i];
      v0[0][n][i] = at->end_position[n] * v[i];
    }
  TRY(solve_vectors(at, 1, 1, y0, v0, y, w, z, look));
  v[INPUT_T + 1] += v[INPUT_T];
  add_input_gradient(at->given, at->u[0], 2 * M + POINT_DERIVATIVES, v);
  for (int i = 0; i < M; i++) {
    lanes placed[GROUPS], pushed[GROUPS], grown[GROUPS];
    for (int n = 0; n < GROUPS; n++) {
      placed[n] = z[0][n][i];
      pushed[n] = w[0][n][i];
      grown[n] = z[0][n][i] * at->D[n][i] + w[0][n][i] * at->E[n][i];
    }
    by_h += v[i] * at->dq[i] + v[M + i] * at->dp[i] + points_total(grown);
    v[i] += points_total(placed);
    v[M + i] += points_total(pushed);
  }
  v[INPUT_T + 1] += by_h / at->step->h;
  return OK;
}
