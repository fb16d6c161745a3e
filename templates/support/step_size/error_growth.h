#include "../iteration/separable_iteration.h"
#include "../run/run.h"

/* Growth of errors along an adaptive run: the relative size of one tangent vector (dq, dv), dq'' = F_q dq / m, which an
 * explicit Runge-Kutta-Nystroem scheme advances by each accepted step. Its nodes are points of the step, at which
 * F_q is evaluated in SIMD lanes; a_0 is extrapolated from the step before. Where h^2 F_q / m is large, the scheme is
 * corrected by fixed-point iterations x = x0 + h^2 P (F_q x) / m of the equations of the step itself. Every second step
 * the vector is projected on the energy surface (in the metric of the sizes of q and v): its part along the gradient of
 * the energy, which is conserved, grows by the error of the scheme only. Requires: the tables of the scheme,
 * point_derivatives and derivative_product. */

#define LOOSE_TOLERANCE 2 /* value of measures_growth for tolerances above 1e-6 */
#define SAMPLED_STEPS 2 /* one of so many steps is projected and measured */
#define LEAST_GROWTH 9.9 /* logarithm: of less, the difference to the mean is not measured */
#define LARGEST_GROWTH 100.0 /* logarithm: beyond it the growth is known; below the reciprocal numbers underflow */
#define LARGEST_SQUARE 1e140 /* of sizes: the products of two are numbers */
#define UNRESOLVED_SQUARE 1e4 /* of h^2 F_q x / m relative to x */
#define LOG_2 0.6931471805599453

typedef lanes vector_at_points[M + FORCE_DERIVATIVES]; /* x, then the derivatives F_q */

/* Number of corrections, by the square of the size of a = h^2 F_q x / m relative to x: the fewest by which regular
 * motions of eleven systems show no exponential growth at tolerances up to 1e-6, and at larger ones (LOOSE_TOLERANCE).
 * The error of k of them is about |a / x|^k / (2 k)!; the measurement ends where 16 do not suffice. */
static inline int corrections_of(run_memory *run, const lanes *x, const double *a)
{
  static const double most[2][4] = {{3.0, 12.0, 60.0, 250.0}, {0.3, 0.3, 3.0, 30.0}};
  const double *limit = most[run->measures_growth == LOOSE_TOLERANCE];
  double of_x = 0.0, of_a = 0.0;
  for (int i = 0; i < M; i++) {
    of_x += x[i][0] * x[i][0];
    of_a += a[i] * a[i];
  }
  if (of_a < limit[0] * of_x)
    return 0;
  if (of_a > UNRESOLVED_SQUARE * of_x)
    run->measures_growth = run->growth_samples = 0;
  if (of_a > 500.0 * of_x)
    return 16;
  return of_a < limit[1] * of_x ? 1 : of_a < limit[2] * of_x ? 2
      : of_a < limit[3] * of_x                               ? 4
                                                             : 8;
}

/* Accelerations F_q x / m times h^2 at all points. */
static inline void accelerations(const step_data *step, const double *unit, vector_at_points *x, coordinates *a)
{
  for (int n = 0; n < GROUPS; n++) {
    derivative_product(x[n], lanes_of(step->t), step->parameters, a[n]);
    for (int i = 0; i < M; i++)
      a[n][i] *= unit[i];
  }
}

/* Improves the end of the step, by iterations from the stages of the explicit scheme. */
static __attribute__((noinline)) void correct_tangent(run_memory *run, const step_data *step, const double *unit,
    vector_at_points *x, const double *q, const double *v, double (*stages)[M], int corrections)
{
  const double inverse = 1.0 / step->h;
  lanes end[GROUPS], column[NODES][GROUPS];
  coordinates a[GROUPS];
  memcpy(end, AT_END, sizeof end);
  memcpy(column, FROM_NODES, sizeof column);
  for (int i = 0; i < M; i++)
    for (int n = 0; n < GROUPS; n++) {
      x[n][i] = q[i] + DRIFT[n] * v[i];
#pragma GCC unroll 4
      for (int s = 0; s < NODES; s++)
        x[n][i] += column[s][n] * stages[s][i];
    }
  accelerations(step, unit, x, a);
  for (int k = 1; k < corrections; k++) {
    for (int i = 0; i < M; i++)
      for (int n = 0; n < GROUPS; n++)
        x[n][i] = q[i] + DRIFT[n] * v[i] + apply(PRODUCT, n, a, i);
    accelerations(step, unit, x, a);
  }
  for (int i = 0; i < M; i++) {
    run->tangent_q[i] = q[i] + v[i] + weigh(POINT_END_POSITION, a, i);
    run->tangent_v[i] = inverse * (v[i] + weigh(POINT_END_MOMENTUM, a, i));
    run->tangent_a[i] = inverse * inverse * weigh(end, a, i);
  }
}

/* Advances the tangent vector by a step. The stages are the same in all lanes, of which each uses the derivatives at
 * one point: reading single lanes of all derivatives would take longer. */
static inline void advance_tangent(run_memory *run, const step_data *step, const iteration_data *data,
    coordinates *X)
{
  const double h = step->h, inverse = 1.0 / h;
  double unit[M], q[M], v[M], stages[NODES][M];
  lanes F[M];
  vector_at_points x[GROUPS];
  int corrections;
  for (int n = 0; n < GROUPS; n++)
    point_derivatives(X[n], step->t + h * ABSCISSA[n], step->parameters, x[n] + M);
  for (int i = 0; i < M; i++) {
    unit[i] = data->square * data->inverse_mass[i];
    q[i] = run->tangent_q[i];
    v[i] = h * run->tangent_v[i];
  }
#pragma GCC unroll 4
  for (int s = 0; s < NODES; s++) {
    lanes *u = x[NODE_POINT[s] / LANES];
#pragma GCC unroll 8
    for (int i = 0; i < M; i++) {
      double at_node = q[i] + NODE[s] * v[i] + NODE_POSITION[s][0] * (data->square * run->tangent_a[i]);
#pragma GCC unroll 4
      for (int j = 0; j < s; j++)
        at_node += NODE_POSITION[s][j + 1] * stages[j][i];
      u[i] = lanes_of(at_node);
    }
    derivative_product(u, lanes_of(step->t), step->parameters, F);
#pragma GCC unroll 8
    for (int i = 0; i < M; i++)
      stages[s][i] = unit[i] * F[i][NODE_POINT[s] % LANES];
  }
  corrections = corrections_of(run, x[NODE_POINT[NODES - 1] / LANES], stages[NODES - 1]);
  if (corrections > 0) {
    correct_tangent(run, step, unit, x, q, v, stages, corrections);
    return;
  }
  for (int i = 0; i < M; i++) {
    double end_q = q[i] + v[i], end_v = v[i], end_a = 0.0;
#pragma GCC unroll 4
    for (int s = 0; s < NODES; s++) {
      end_q += NODES_END_POSITION[s] * stages[s][i];
      end_v += NODES_END_VELOCITY[s] * stages[s][i];
      end_a += NODES_END_ACCELERATION[s] * stages[s][i];
    }
    run->tangent_q[i] = end_q;
    run->tangent_v[i] = inverse * end_v;
    run->tangent_a[i] = inverse * inverse * end_a;
  }
}

/* Logarithm to base 2, linear between powers of two: less than .09 too small. */
static inline double logarithm(double x)
{
  long long bits;
  memcpy(&bits, &x, sizeof bits);
  return (double)bits * 0x1p-52 - 1023.0;
}

/* Projects the tangent vector on the energy surface at the end of the step and measures it. */
static inline void sample_growth(run_memory *run, const step_data *step, const iteration_data *data, const double *dq,
    const double *dp)
{
  double f[M], p[M], q2 = 0.0, v2 = 0.0, along = 0.0, size = 0.0, dq2 = 0.0, dv2 = 0.0, growth;
  lanes end[GROUPS], F[GROUPS][M];
  memcpy(end, AT_END, sizeof end);
  lanes_load(run->memory, F);
  for (int i = 0; i < M; i++) {
    const double q = step->q0[i] + dq[i];
    double v;
    p[i] = step->p0[i] + dp[i];
    v = data->inverse_mass[i] * p[i];
    f[i] = weigh(end, F, i);
    q2 += q * q;
    v2 += v * v;
    along += p[i] * run->tangent_v[i] - f[i] * run->tangent_q[i];
  }
  for (int i = 0; i < M; i++)
    size += f[i] * f[i] * q2 + p[i] * p[i] * v2;
  run->largest_q2 = larger(run->largest_q2, q2);
  run->largest_v2 = larger(run->largest_v2, v2);
  along /= size;
  for (int i = 0; i < M; i++) {
    run->tangent_q[i] += along * q2 * f[i];
    run->tangent_v[i] -= along * v2 * p[i];
    dq2 += run->tangent_q[i] * run->tangent_q[i];
    dv2 += run->tangent_v[i] * run->tangent_v[i];
  }
  growth = 0.5 * LOG_2 *
      logarithm(larger(dq2 * run->largest_v2, dv2 * run->largest_q2) / (run->largest_q2 * run->largest_v2));
  run->growth = growth;
  run->growth_sum += growth;
  run->growth_samples++;
  if (growth >= LEAST_GROWTH)
    run->growth_excess = larger(run->growth_excess, growth - run->growth_sum / (double)run->growth_samples);
  if (!(fabs(growth) < LARGEST_GROWTH && larger(run->largest_q2, run->largest_v2) < LARGEST_SQUARE)) {
    run->measures_growth = 0;
    run->growth_samples = growth >= LARGEST_GROWTH ? run->growth_samples : 0;
  }
}

/* Advances the tangent vector, which starts as a relative perturbation of the state, by an accepted step. */
static __attribute__((noinline)) void measure_growth(run_memory *run, const step_data *step,
    const iteration_data *data, coordinates *X, const double *dq, const double *dp)
{
  if (run->tangent_steps == 0)
    for (int i = 0; i < M; i++) {
      run->tangent_q[i] = step->q0[i] * cos(i);
      run->tangent_v[i] = data->inverse_mass[i] * step->p0[i] * cos(i + 1);
    }
  advance_tangent(run, step, data, X);
  if (run->tangent_steps++ % SAMPLED_STEPS == 0 && run->measures_growth)
    sample_growth(run, step, data, dq, dp);
}
