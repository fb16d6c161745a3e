#include "../core/status_codes.h"
#include "../iteration/one_trajectory.h"
#include "../iteration/separable_iteration.h"
#include "vector_convergence.h"

/* Derivatives of a step solved by separable_iteration.h and their transpose, by fixed-point iteration. With D = X - q0,
 * the derivatives K = F_q at the points, s = h^2 / m and P the table PRODUCT, the variations x of the points and the
 * adjoint variables y of the forces are the fixed points of
 *   x = x0 + s P (K x),      y = y0 + s P^T (K^T y),
 * which converge at the rate of the step itself. The derivatives are those of the exact solution of the stage
 * equations. Requires: PRODUCT_BACK, the transposed table, point_derivatives and derivative_product,
 * TRANSPOSED_PRODUCT, POINT_INPUTS and input_derivatives, MASS_INPUTS and mass_by_inputs. */

enum { STORED_OF_STEP = M * (POINTS + 2) }; /* numbers: D, then the increments of q and p */

/* Linearisation of a solved step: displacements D of its points from q0, the increments, and the derivatives of its
 * forces behind memory for M variations. */
typedef struct {
  const step_data *step;
  const iteration_data *data;
  const double *dq, *dp;
  double scale[M], mass[M];
#ifdef VARIABLE_MASSES
  double mass_derivative[MASS_DERIVATIVES];
#endif
  lanes D[GROUPS][M], u[GROUPS][M + POINT_DERIVATIVES], given[GROUPS][INPUT_DERIVATIVES];
  double accepted; /* squared: relative change of vectors still to come that is accepted */
} iterated_step;

/* Stores the displacements and increments of a step, from which linearise_points linearises it. */
static void store_step(const step_data *step, const iteration_data *data, const double *memory, const double *dq,
    const double *dp, double *to)
{
  lanes F[GROUPS][M], D[GROUPS][M];
  lanes_load(memory, F);
  for (int i = 0; i < M; i++)
    for (int n = 0; n < GROUPS; n++)
      D[n][i] = DRIFT[n] * (step->h * (data->inverse_mass[i] * step->p0[i])) +
          (data->square * data->inverse_mass[i]) * apply(PRODUCT, n, F, i);
  lanes_store(D, to);
  memcpy(to + M * POINTS, dq, sizeof(double) * M);
  memcpy(to + M * (POINTS + 1), dp, sizeof(double) * M);
}

static __attribute__((noinline)) void linearise_points(const step_data *step, const iteration_data *data,
    const double *stored, iterated_step *at)
{
  lanes X[GROUPS][M];
  at->step = step;
  at->data = data;
  at->dq = stored + M * POINTS;
  at->dp = at->dq + M;
  lanes_load(stored, at->D);
  for (int i = 0; i < M; i++) {
    at->scale[i] = data->square * data->inverse_mass[i];
    at->mass[i] = fabs(1.0 / data->inverse_mass[i]);
  }
  for (int n = 0; n < GROUPS; n++) {
    const lanes t = step->t + step->h * ABSCISSA[n];
    for (int i = 0; i < M; i++)
      X[n][i] = step->q0[i] + at->D[n][i];
    point_derivatives(X[n], t, step->parameters, at->u[n] + M);
    input_derivatives(X[n], t, step->parameters, at->given[n]);
  }
#ifdef VARIABLE_MASSES
  mass_by_inputs(NULL, step->t, step->parameters, at->mass_derivative);
#endif
}

/* f = K x; back: K^T x. */
static inline void apply_derivatives(
    iterated_step *at, int back, int count, lanes (*x)[GROUPS][M], lanes (*f)[GROUPS][M])
{
  const step_data *step = at->step;
  for (int j = 0; j < count; j++)
    for (int n = 0; n < GROUPS; n++) {
      memcpy(at->u[n], x[j][n], sizeof x[j][n]);
      (back ? TRANSPOSED_PRODUCT : derivative_product)(at->u[n], lanes_of(step->t), step->parameters, f[j][n]);
    }
}

/* The next iterate of x, whose constant term is x0. */
static inline lanes next_change(const iterated_step *at, const lanes *table, lanes (*x0)[M], lanes (*f)[M], int n,
    int i)
{
  return x0[n][i] + at->scale[i] * apply(table, n, f, i);
}

#ifdef LINEAR_FORCES
#define CORRECTS_LINEAR_PART(at, back) (!(back) && (at)->data->linear.is_used) /* as the iteration of the step */
#define correct_linear_part(at, residual) solve_linear_part(&(at)->data->linear, (residual)[0])
#else
#define CORRECTS_LINEAR_PART(at, back) 0
#define correct_linear_part(at, residual) (void)0
#endif

/* Moves x by the residual of its equation, or by the correction for it; adds squares of moves and sizes in the metric
 * of the masses, independent of the units of the coordinates. */
static inline __attribute__((always_inline)) void improve_vector(const iterated_step *at, int back, lanes (*x0)[M],
    lanes (*f)[M], lanes (*x)[M], double *largest)
{
  lanes moved[GROUPS] = {{0.0}}, size[GROUPS] = {{0.0}}, change[GROUPS][M];
  for (int i = 0; i < M; i++)
    for (int n = 0; n < GROUPS; n++)
      change[n][i] = next_change(at, back ? PRODUCT_BACK : PRODUCT, x0, f, n, i) - x[n][i];
  if (CORRECTS_LINEAR_PART(at, back))
    correct_linear_part(at, change);
  for (int i = 0; i < M; i++)
    for (int n = 0; n < GROUPS; n++) {
      x[n][i] += change[n][i];
      moved[n] += at->mass[i] * (change[n][i] * change[n][i]);
      size[n] += at->mass[i] * (x[n][i] * x[n][i]);
    }
  keep_largest(points_total(moved), points_total(size), largest);
}

/* Solves for some x, which start as x0, and f = K x, together; back: the transpose. */
static inline __attribute__((always_inline)) int solve_vectors(iterated_step *at, int back, int count,
    lanes (*x)[GROUPS][M], lanes (*f)[GROUPS][M], int *look)
{
  const lanes *table = back ? PRODUCT_BACK : PRODUCT;
  lanes x0[VECTORS_AT_ONCE][GROUPS][M];
  vector_changes past = {INFINITY, INFINITY, at->accepted};
  int status = 0;
  memcpy(x0, x, sizeof *x * (size_t)count);
  apply_derivatives(at, back, count, x, f);
  for (int k = 0; status == 0; k++) {
    double largest[2] = {0.0, 0.0};
    if (k < *look && !CORRECTS_LINEAR_PART(at, back)) {
      for (int j = 0; j < count; j++)
        for (int i = 0; i < M; i++)
          for (int n = 0; n < GROUPS; n++)
            x[j][n][i] = next_change(at, table, x0[j], f[j], n, i);
    } else {
      for (int j = 0; j < count; j++)
        improve_vector(at, back, x0[j], f[j], x[j], largest);
      status = vectors_status(largest[0], largest[1], &past, k, look);
    }
    apply_derivatives(at, back, count, x, f);
  }
  return status == 1 ? OK : NOT_CONVERGED;
}

/* Variations of the masses. */
static inline void vary_masses(iterated_step *at, const double *v, double *dm)
{
  memset(dm, 0, sizeof(double) * M);
#ifdef VARIABLE_MASSES
  for (int e = 0; e < MASS_DERIVATIVES; e++)
    dm[MASS_INPUTS[e][0]] += at->mass_derivative[e] * v[2 * M + MASS_INPUTS[e][1]];
#endif
}

/* Returns 1 if only q0 and p0 vary. */
static inline int is_of_state(const double *v)
{
  int none = 1;
  for (int j = 2 * M; j < STEP_INPUTS; j++)
    none &= v[j] == 0.0;
  return none;
}

/* Replaces v, variations of (q0, p0, parameters, t, h), by those of (q1, p1, parameters, t + h, h) (JVP). */
static inline __attribute__((always_inline)) int vary_step(iterated_step *at, int count, double (*v)[STEP_INPUTS],
    int *look)
{
  const iteration_data *data = at->data;
  const double h = at->step->h;
  double drift[VECTORS_AT_ONCE][M], by_length[VECTORS_AT_ONCE][M];
  lanes x[VECTORS_AT_ONCE][GROUPS][M], f[VECTORS_AT_ONCE][GROUPS][M], F[VECTORS_AT_ONCE][GROUPS][M];
  for (int j = 0; j < count; j++) {
    const double dh = v[j][INPUT_T + 1] / h;
    const int of_state = is_of_state(v[j]);
    double dm[M];
    vary_masses(at, v[j], dm);
    vary_by_inputs(at->given, v[j], F[j][0], M);
    for (int i = 0; i < M; i++) {
      by_length[j][i] = 2.0 * dh - data->inverse_mass[i] * dm[i];
      drift[j][i] = h * data->inverse_mass[i] * (v[j][M + i] - dh * at->step->p0[i]);
      for (int n = 0; n < GROUPS; n++)
        x[j][n][i] = v[j][i] + DRIFT[n] * drift[j][i] + by_length[j][i] * at->D[n][i];
      for (int n = 0; !of_state && n < GROUPS; n++)
        x[j][n][i] += at->scale[i] * apply(PRODUCT, n, F[j], i);
    }
  }
  TRY(solve_vectors(at, 0, count, x, f, look));
  for (int j = 0; j < count; j++) {
    for (int i = 0; i < M; i++) {
      for (int n = 0; n < GROUPS; n++)
        F[j][n][i] += f[j][n][i];
      v[j][i] += drift[j][i] + by_length[j][i] * at->dq[i] + at->scale[i] * weigh(POINT_END_POSITION, F[j], i);
      v[j][M + i] += v[j][INPUT_T + 1] / h * at->dp[i] + weigh(data->kick, F[j], i);
    }
    v[j][INPUT_T] += v[j][INPUT_T + 1];
  }
  return OK;
}

/* Replaces v, adjoint variables of (q1, p1, parameters, t + h, h), by those of (q0, p0, parameters, t, h) (VJP). */
static __attribute__((noinline)) int vjp_by_iteration(iterated_step *at, double *v, int *look)
{
  const iteration_data *data = at->data;
  const double h = at->step->h;
  double by_length[M], by_h = 0.0;
  lanes x[1][GROUPS][M], f[1][GROUPS][M];
  for (int i = 0; i < M; i++)
    for (int n = 0; n < GROUPS; n++)
      x[0][n][i] = POINT_END_POSITION[n] * (at->scale[i] * v[i]) + data->kick[n] * v[M + i];
  TRY(solve_vectors(at, 1, 1, x, f, look));
  v[INPUT_T + 1] += v[INPUT_T];
  add_input_gradient(at->given, at->u[0], M + POINT_DERIVATIVES, v);
  for (int i = 0; i < M; i++) {
    lanes part[GROUPS], turned[GROUPS], drifted[GROUPS];
    for (int n = 0; n < GROUPS; n++) {
      part[n] = f[0][n][i];
      turned[n] = f[0][n][i] * at->D[n][i];
      drifted[n] = f[0][n][i] * DRIFT[n];
    }
    const double drift = h * data->inverse_mass[i] * (v[i] + points_total(drifted));
    by_length[i] = v[i] * at->dq[i] + points_total(turned);
    by_h += 2.0 * by_length[i] - drift * at->step->p0[i] + v[M + i] * at->dp[i];
    v[i] += points_total(part);
    v[M + i] += drift;
  }
  v[INPUT_T + 1] += by_h / h;
#ifdef VARIABLE_MASSES
  for (int e = 0; e < MASS_DERIVATIVES; e++) {
    const int i = MASS_INPUTS[e][0];
    v[2 * M + MASS_INPUTS[e][1]] -= data->inverse_mass[i] * at->mass_derivative[e] * by_length[i];
  }
#endif
  return OK;
}
