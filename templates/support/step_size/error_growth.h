#include "../run/run.h"

/* Growth of errors along an adaptive run: the size of one tangent vector (dq, dv) relative to the motion, the largest
 * distance from the start and the largest velocity, which depend neither on the origin nor on a gauge. An explicit
 * Runge-Kutta-Nystroem scheme advances it by each accepted step. Its accelerations are those of the variational
 * equations,
 *   dq'' = F_q dq / m,      or      L_vv dq'' = -E_q dq - E_v dv   (VARIABLE_ACCELERATIONS),
 * with E(q, v, a) the Euler-Lagrange residual at the points of the step, whose derivatives are evaluated in SIMD lanes.
 * The nodes of the scheme are some of the points; a_0 is extrapolated from the step before. Where h^2 dq'' is large,
 * the scheme is corrected by fixed-point iterations of the collocation equations at all points. Every second or fourth
 * step the vector is projected on the energy surface (in the metric of the sizes of the motion): its part along the
 * gradient of the energy, which is conserved, grows by the error of the scheme only. Requires: the iteration, the
 * tables of the scheme, point_derivatives and derivative_product; with VARIABLE_ACCELERATIONS energy_gradient. */

#define AT_ROUNDOFF 1 /* values of measures_growth: no tolerance is given */
#define LOOSE_TOLERANCE 3 /* a tolerance above 1e-6 */
#define SAMPLED_AT_ROUNDOFF 4 /* one of so many steps is projected and measured */
#define SAMPLED 2 /* with a tolerance */
#define LEAST_GROWTH 9.9 /* logarithm: of less, the difference to the mean is not measured */
#define LARGEST_GROWTH 100.0 /* logarithm: beyond it the growth is known; below the reciprocal numbers underflow */
#define LARGEST_SQUARE 1e140 /* of sizes: the products of two are numbers */
#define UNRESOLVED_SQUARE 1e4 /* of h^2 F_q x / m relative to x */
#define MANY_POINTS (POINTS > 8) /* steps are longer */
#define MOST_CORRECTIONS 40
#define LOG_2 0.6931471805599453

#ifdef ENERGY_CONSERVED
enum { LESS_ERROR = 0 };
#define KNOWN(growth) ((growth) >= LARGEST_GROWTH)
#define START(x, change) (x)
#else
enum { LESS_ERROR = 1 }; /* no projection reduces that of the scheme */
#define KNOWN(growth) (fabs(growth) >= LARGEST_GROWTH) /* damping reduces errors */
#define START(x, change) ((x) + (change)) /* motions often start at rest at the origin */
#endif

#ifdef VARIABLE_ACCELERATIONS
enum { TANGENT = 2 * M }; /* numbers of a tangent vector on which accelerations depend */
#define VECTOR_SQUARE(x, v) ((x) * (x) + (v) * (v))
/* Squared change of h^2 dq'' by a correction, relative to the vector, after which another one is necessary. */
#define UNSETTLED(change) ((change) > (LESS_ERROR ? 1e-4 : MANY_POINTS ? 0.01 \
                                                                       : 1.0))
/* Squared residual of the last stage relative to the vector. */
#define SMALL_REST (LESS_ERROR ? 1e-4 : MANY_POINTS ? 0.01 \
                                                    : 0.1)
#else
enum { TANGENT = M };
#define VECTOR_SQUARE(x, v) ((x) * (x))
#define UNSETTLED(change) (LESS_ERROR && (change) > 1e-4) /* otherwise corrections converge like those of a sine */
#define SMALL_REST (LESS_ERROR ? 1e-4 : MANY_POINTS ? 0.01 \
                                                    : 1.0)
#endif

/* Explicit scheme: nodes among the points, and weights of the stages (NODES at most). */
typedef struct {
  int nodes;
  const int *point;
  const double *node, (*position)[NODES + 1], (*velocity)[NODES + 1], *expected;
  const double *end_position, *end_velocity, *end_acceleration, (*at_points)[POINTS];
} tangent_scheme;

#ifdef VARIABLE_ACCELERATIONS
#define VELOCITY_TABLE(name) VELOCITY_##name
#else
#define VELOCITY_TABLE(name) NULL
#endif
#define SCHEME(name)                                                                                \
  {NODES_##name, POINT_##name, NODE_##name, POSITION_##name, VELOCITY_TABLE(name), EXPECTED_##name, \
      END_POSITION_##name, END_VELOCITY_##name, END_ACCELERATION_##name, AT_POINTS_##name}

/* Tangent vectors at the points of a group, and the derivatives by which they are multiplied. */
typedef lanes tangent_at_points[TANGENT + GROWTH_DERIVATIVES];

#ifdef VARIABLE_ACCELERATIONS
typedef struct {
  tangent_at_points u[GROUPS];
  lanes mass[GROUPS][MASS];
  double square, inverse; /* h^2, 1 / h */
} tangent_points;

/* Computes the derivatives of the accelerations at the points of a step from their velocities in the run's memory. */
static inline void linearise_accelerations(const run_memory *run, const step_data *step, const iteration_data *data,
    coordinates *X, tangent_points *at)
{
  lanes V[GROUPS][M], scaled[GROUPS][M], u[3 * M];
  (void)X;
  lanes_load(run->memory, V);
  scale(data->position_weight, V, scaled);
  for (int n = 0; n < GROUPS; n++) {
    place(step, n, scaled, V, u);
    for (int i = 0; i < M; i++)
      u[2 * M + i] = at->inverse * apply(VELOCITY_RATE, n, V, i);
    memset(at->mass[n], 0, sizeof at->mass[n]);
    point_derivatives(u, step->t + step->h * ABSCISSA[n], step->parameters, at->u[n] + TANGENT, at->mass[n]);
    factor_mass(at->mass[n]);
  }
}

/* Accelerations times h^2 of the tangent vectors at the points of a group. */
static inline void tangent_accelerations(const step_data *step, const tangent_points *at, int n, lanes *a)
{
  derivative_product(at->u[n], lanes_of(step->t), step->parameters, a);
  solve_mass(at->mass[n], a);
  for (int i = 0; i < M; i++)
    a[i] *= at->square;
}
#else
typedef struct {
  tangent_at_points u[GROUPS];
  double unit[M]; /* h^2 / m */
} tangent_points;

static inline void linearise_accelerations(const run_memory *run, const step_data *step, const iteration_data *data,
    coordinates *X, tangent_points *at)
{
  (void)run;
  for (int n = 0; n < GROUPS; n++)
    point_derivatives(X[n], step->t + step->h * ABSCISSA[n], step->parameters, at->u[n] + TANGENT);
  for (int i = 0; i < M; i++)
    at->unit[i] = data->square * data->inverse_mass[i];
}

static inline void tangent_accelerations(const step_data *step, const tangent_points *at, int n, lanes *a)
{
  derivative_product(at->u[n], lanes_of(step->t), step->parameters, a);
  for (int i = 0; i < M; i++)
    a[i] *= at->unit[i];
}
#endif

/* Number of corrections: none if the last stage differs little from the extrapolation of those before; else by the
 * square of the size of a = h^2 dq'' relative to that of the vector, the fewest by which regular motions of nineteen
 * systems show no exponential growth. The error of k of them is about |a / x|^k / (2 k)!, or |a / x|^k / k! if forces
 * depend on velocities; the measurement ends where 16 do not suffice. */
static inline int corrections_of(run_memory *run, double of_x, double of_a, double of_rest)
{
#ifdef VARIABLE_ACCELERATIONS
  static const double most[2][3] = {{0.1, 1.0, 10.0}, {0.1, 1.0, 10.0}};
#else
  static const double most[2][3] = {{12.0, 60.0, 250.0}, {0.3, 3.0, 30.0}};
#endif
  const double *limit = most[run->measures_growth >= (MANY_POINTS ? LOOSE_TOLERANCE - 1 : LOOSE_TOLERANCE)];
  if (of_rest < SMALL_REST * of_x)
    return 0;
  if (of_a > UNRESOLVED_SQUARE * of_x)
    run->measures_growth = run->growth_samples = 0;
  if (of_a > 500.0 * of_x)
    return of_a > 2500.0 * of_x ? 16 : 10;
  if (of_a > limit[2] * of_x)
    return of_a > 130.0 * of_x ? 8 : 6;
  return of_a < limit[0] * of_x ? 1 : of_a < limit[1] * of_x ? 2
                                                             : 4;
}

/* Tangent vectors at the points, from the vector (q, h v) at the start and the accelerations a. */
static inline void place_tangents(const double *q, const double *v, coordinates *a, tangent_points *at)
{
  for (int i = 0; i < M; i++) {
#ifdef VARIABLE_ACCELERATIONS
    coordinates V[GROUPS];
    for (int n = 0; n < GROUPS; n++) {
      V[n][0] = v[i] + apply(TANGENT_INTEGRALS, n, a, i);
      at->u[n][M + i] = at->inverse * V[n][0];
    }
    for (int n = 0; n < GROUPS; n++)
      at->u[n][i] = q[i] + apply(TANGENT_INTEGRALS, n, V, 0);
#else
    for (int n = 0; n < GROUPS; n++)
      at->u[n][i] = q[i] + DRIFT[n] * v[i] + apply(PRODUCT, n, a, i);
#endif
  }
}

/* Mean over the points of the squared change of accelerations. */
static inline double change_between(coordinates *one, coordinates *other)
{
  lanes sum = lanes_of(0.0);
  for (int i = 0; i < M; i++)
    for (int n = 0; n < GROUPS; n++)
      sum += (other[n][i] - one[n][i]) * (other[n][i] - one[n][i]);
  return lanes_total(sum) / POINTS;
}

/* Improves the end of the step, by iterations from the stages of the explicit scheme; ends the measurement if they
 * diverge, as those of forces of velocities may. */
static __attribute__((noinline)) void correct_tangent(run_memory *run, const step_data *step, tangent_points *at,
    const tangent_scheme *of, const double *q, const double *v, double (*stages)[M], double of_x,
    int corrections)
{
  const double inverse = 1.0 / step->h;
  double change = INFINITY;
  lanes end[GROUPS];
  coordinates a[GROUPS], before[GROUPS];
  memcpy(end, AT_END, sizeof end);
  memset(a, 0, sizeof a);
  for (int s = 0; s < of->nodes; s++) {
    lanes column[GROUPS];
    memcpy(column, of->at_points[s], sizeof column);
    for (int i = 0; i < M; i++)
      for (int n = 0; n < GROUPS; n++)
        a[n][i] += column[n] * stages[s][i];
  }
  for (int k = 0; k < corrections || (UNSETTLED(change) && k < MOST_CORRECTIONS); k++) {
    place_tangents(q, v, a, at);
    memcpy(before, a, sizeof before);
    for (int n = 0; n < GROUPS; n++)
      tangent_accelerations(step, at, n, a[n]);
    if (UNSETTLED(change))
      change = change_between(before, a) / of_x;
  }
  if (UNSETTLED(change))
    run->measures_growth = run->growth_samples = 0;
  for (int i = 0; i < M; i++) {
#ifdef VARIABLE_ACCELERATIONS
    coordinates V[GROUPS];
    for (int n = 0; n < GROUPS; n++)
      V[n][0] = v[i] + apply(TANGENT_INTEGRALS, n, a, i);
    run->tangent_q[i] = q[i] + weigh(TANGENT_END, V, 0);
    run->tangent_v[i] = inverse * (v[i] + weigh(TANGENT_END, a, i));
#else
    run->tangent_q[i] = q[i] + v[i] + weigh(POINT_END_POSITION, a, i);
    run->tangent_v[i] = inverse * (v[i] + weigh(POINT_END_MOMENTUM, a, i));
#endif
    run->tangent_a[i] = inverse * inverse * weigh(end, a, i);
  }
}

/* Advances the tangent vector by a step. The stages are the same in all lanes, of which each uses the derivatives at
 * one point: reading single lanes of all derivatives would take longer. */
static inline __attribute__((always_inline)) void advance_tangent(run_memory *run, const step_data *step,
    const iteration_data *data, coordinates *X, const tangent_scheme *of)
{
  const double h = step->h, inverse = 1.0 / h, square = h * h;
  double q[M], v[M], stages[NODES][M], of_x = 0.0, of_a = 0.0, of_rest = 0.0;
  lanes F[M];
  tangent_points at;
  int corrections;
#ifdef VARIABLE_ACCELERATIONS
  at.square = square;
  at.inverse = inverse;
#endif
  linearise_accelerations(run, step, data, X, &at);
  for (int i = 0; i < M; i++) {
    q[i] = run->tangent_q[i];
    v[i] = h * run->tangent_v[i];
  }
#pragma GCC unroll 4
  for (int s = 0; s < of->nodes; s++) {
    lanes *u = at.u[of->point[s] / LANES];
#pragma GCC unroll 8
    for (int i = 0; i < M; i++) {
      double at_node = q[i] + of->node[s] * v[i] + of->position[s][0] * (square * run->tangent_a[i]);
#pragma GCC unroll 4
      for (int j = 0; j < s; j++)
        at_node += of->position[s][j + 1] * stages[j][i];
      u[i] = lanes_of(at_node);
#ifdef VARIABLE_ACCELERATIONS
      at_node = v[i] + of->velocity[s][0] * (square * run->tangent_a[i]);
#pragma GCC unroll 4
      for (int j = 0; j < s; j++)
        at_node += of->velocity[s][j + 1] * stages[j][i];
      u[M + i] = lanes_of(inverse * at_node);
#endif
    }
    tangent_accelerations(step, &at, of->point[s] / LANES, F);
#pragma GCC unroll 8
    for (int i = 0; i < M; i++)
      stages[s][i] = F[i][of->point[s] % LANES];
  }
  for (int i = 0; i < M; i++) {
    const double x = at.u[of->point[of->nodes - 1] / LANES][i][0], a = stages[of->nodes - 1][i];
    double rest = a - of->expected[0] * (square * run->tangent_a[i]);
#pragma GCC unroll 4
    for (int s = 1; s < of->nodes; s++)
      rest -= of->expected[s] * stages[s - 1][i];
    of_x += VECTOR_SQUARE(x, v[i]);
    of_a += a * a;
    of_rest += rest * rest;
  }
  corrections = corrections_of(run, of_x, of_a, of_rest);
  if (corrections > 0) {
    correct_tangent(run, step, &at, of, q, v, stages, of_x, corrections);
    return;
  }
  for (int i = 0; i < M; i++) {
    double end_q = q[i] + v[i], end_v = v[i], end_a = 0.0;
#pragma GCC unroll 4
    for (int s = 0; s < of->nodes; s++) {
      end_q += of->end_position[s] * stages[s][i];
      end_v += of->end_velocity[s] * stages[s][i];
      end_a += of->end_acceleration[s] * stages[s][i];
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

/* Velocities v and the gradient of the energy with respect to (q, v) at the end q of the step. */
static inline void end_gradient(const run_memory *run, const step_data *step, const iteration_data *data,
    const double *q, const double *dp, double *v, double *by_q, double *by_v)
{
  lanes end[GROUPS], F[GROUPS][M]; /* forces, or velocities */
  memcpy(end, AT_END, sizeof end);
  lanes_load(run->memory, F);
#ifdef VARIABLE_ACCELERATIONS
  (void)data, (void)dp;
  for (int i = 0; i < M; i++)
    v[i] = weigh(end, F, i);
#ifdef ENERGY_CONSERVED
  lanes u[2 * M], value[2 * M];
  for (int i = 0; i < M; i++) {
    u[i] = lanes_of(q[i]);
    u[M + i] = lanes_of(v[i]);
  }
  energy_gradient(u, lanes_of(step->t), step->parameters, value);
  for (int i = 0; i < M; i++) {
    by_q[i] = value[i][0];
    by_v[i] = value[M + i][0];
  }
#else
  (void)q, (void)step, (void)by_q, (void)by_v;
#endif
#else
  (void)q;
  for (int i = 0; i < M; i++) {
    by_q[i] = -weigh(end, F, i);
    by_v[i] = step->p0[i] + dp[i];
    v[i] = data->inverse_mass[i] * by_v[i];
  }
#endif
}

/* Projects the tangent vector on the energy surface at the end of the step and measures it, if there is a motion.
 * Exponential growth is that of its size max(dq, dv Q / V) with the sizes Q, V of the motion: relative to a motion that
 * is itself amplified rounding, as one from rest at an unstable equilibrium, it would be constant. */
static inline void sample_growth(run_memory *run, const step_data *step, const iteration_data *data, const double *dq,
    const double *dp)
{
  double q[M], v[M], by_q[M], by_v[M], q2 = 0.0, v2 = 0.0, dq2 = 0.0, dv2 = 0.0, size, growth;
#ifdef ENERGY_CONSERVED
  double along = 0.0, square = 0.0;
#endif
  for (int i = 0; i < M; i++)
    q[i] = step->q0[i] + dq[i];
  end_gradient(run, step, data, q, dp, v, by_q, by_v);
  for (int i = 0; i < M; i++) {
    const double away = (step->q0[i] - run->growth_start[i]) + dq[i];
    q2 += away * away;
    v2 += v[i] * v[i];
  }
  q2 = run->largest_q2 = larger(run->largest_q2, q2);
  v2 = run->largest_v2 = larger(run->largest_v2, v2);
  if (q2 == 0 || v2 == 0)
    return;
#ifdef ENERGY_CONSERVED
  for (int i = 0; i < M; i++) {
    along += by_v[i] * run->tangent_v[i] + by_q[i] * run->tangent_q[i];
    square += by_q[i] * by_q[i] * q2 + by_v[i] * by_v[i] * v2;
  }
  along /= square;
  for (int i = 0; i < M; i++) {
    run->tangent_q[i] -= along * q2 * by_q[i];
    run->tangent_v[i] -= along * v2 * by_v[i];
  }
#endif
  for (int i = 0; i < M; i++) {
    dq2 += run->tangent_q[i] * run->tangent_q[i];
    dv2 += run->tangent_v[i] * run->tangent_v[i];
  }
  size = larger(dq2, dv2 * q2 / v2);
  growth = 0.5 * LOG_2 * logarithm(size / q2);
  size = 0.5 * LOG_2 * logarithm(size);
  run->growth = growth;
  run->growth_sum += size;
  run->growth_samples++;
  if (growth >= LEAST_GROWTH)
    run->growth_excess = larger(run->growth_excess, size - run->growth_sum / (double)run->growth_samples);
  if (!(fabs(growth) < LARGEST_GROWTH && larger(q2, v2) < LARGEST_SQUARE)) {
    run->measures_growth = 0;
    run->growth_samples = KNOWN(growth) ? run->growth_samples : 0;
  }
}

/* Advances the tangent vector, which starts as a relative perturbation of the state, by an accepted step. */
static __attribute__((noinline)) void measure_growth(run_memory *run, const step_data *step,
    const iteration_data *data, coordinates *X, const double *dq, const double *dp)
{
  static const tangent_scheme of_roundoff = SCHEME(OF_ROUNDOFF), of_tolerance = SCHEME(OF_TOLERANCE);
  int sampled = SAMPLED;
  if (run->tangent_steps == 0) {
#ifdef VARIABLE_ACCELERATIONS
    lanes V[GROUPS][M];
    lanes_load(run->memory, V);
#endif
    for (int i = 0; i < M; i++) {
      run->growth_start[i] = step->q0[i];
      run->tangent_q[i] = START(step->q0[i], dq[i]) * cos(i);
#ifdef VARIABLE_ACCELERATIONS
      run->tangent_v[i] = START(at_start(V, i), dq[i] / step->h) * cos(i + 1);
#else
      run->tangent_v[i] = START(data->inverse_mass[i] * step->p0[i], dq[i] / step->h) * cos(i + 1);
#endif
    }
  }
  if (run->measures_growth == AT_ROUNDOFF) {
    sampled = SAMPLED_AT_ROUNDOFF;
    advance_tangent(run, step, data, X, &of_roundoff);
  } else
    advance_tangent(run, step, data, X, &of_tolerance);
  if (run->tangent_steps++ % sampled == 0 && run->measures_growth)
    sample_growth(run, step, data, dq, dp);
}
