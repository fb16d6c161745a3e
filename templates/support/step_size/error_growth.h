#include "../run/run.h"

/* Growth of errors along an adaptive run: the size of one tangent vector (dq, dv) relative to the motion, the largest
 * distance from the start and the largest velocity, which depend neither on the origin nor on a gauge. It solves the
 * variational equations along each accepted step,
 *   dq'' = F_q dq / m,      or      L_vv dq'' = -E_q dq - E_v dv   (VARIABLE_ACCELERATIONS),
 * with E(q, v, a) the Euler-Lagrange residual at knots c_n h, which are Gauss points, as many as those of the step in
 * vectors of eight lanes, or half as many; derivatives there are evaluated in SIMD lanes. The collocation equations
 *   dq_n = dq + c_n h dv + h^2 sum_j P_nj dq''_j,      dv_n = dv + h sum_j Q_nj dq''_j
 * are solved by Picard iterations (Hairer, Norsett & Wanner, Solving ODEs I, sec. I.8) from Taylor's polynomial at the
 * end of the step before; with four knots in two halves of a large step. In one of `measures_growth` steps, which
 * are OF_SMALL_STEPS unless steps are large, the vector is projected on the energy surface (in the metric of the
 * sizes of the motion): its part along the gradient of the energy, which is conserved, grows by the error of the
 * iterations only. Requires: the iteration, tables, the number GROWTH_DERIVATIVES of distinct derivatives at a
 * point, OF_SMALL_STEPS, the kernels point_derivatives and derivative_product; with VARIABLE_ACCELERATIONS
 * energy_gradient. */

#define LEAST_GROWTH 9.9 /* logarithm: of less, the difference to the mean is not measured */
#define LARGEST_GROWTH 100.0 /* logarithm: beyond it the growth is known; below the reciprocal numbers underflow */
#define LARGEST_SQUARE 1e140 /* of sizes: the products of two are numbers */
#define MOST_ITERATIONS 30
#define LOG_2 0.6931471805599453

#ifdef ENERGY_CONSERVED
#define LESS 1.0
#define KNOWN(growth) ((growth) >= LARGEST_GROWTH)
#define INITIAL(x, change) (x)
#else
#define LESS 0.0016 /* no projection reduces the error */
#define KNOWN(growth) (fabs(growth) >= LARGEST_GROWTH) /* damping reduces errors */
#define INITIAL(x, change) ((x) + (change)) /* motions often start at rest at the origin */
#endif

/* Iteration k ends if its change of h^2 dq'' leaves errors that are small beside the vector, by squares of both: where
 * accelerations depend on the positions alone, the next one changes the step by about |h^2 dq''| / (2 k)^4 of it. By
 * larger limits regular orbits of large steps show exponential growth. */
#ifdef VARIABLE_ACCELERATIONS
enum { TANGENT = 2 * M }; /* numbers of a tangent vector on which accelerations depend */
#define IS_SMALL(change, k, size, rate) ((void)(rate), (change) <= (0.0003 * LESS) * (size))
#else
enum { TANGENT = M };
#define IS_SMALL(change, k, size, rate) \
  ((change) * ((rate) + (change)) <= (0.004 * LESS) * ((double)((k) * (k) * (k) * (k)) * ((size) * (size))))
#endif

/* Taylor's coefficients h^k dq^(k) / k!, k < 5, or the knots are columns of the tables: whole vectors of any length. */
enum { TAYLOR = 5,
  COLUMNS = 8,
  KNOT_GROUPS = (KNOTS + LANES - 1) / LANES,
  KNOTS_STORED = KNOT_GROUPS * LANES };

/* Tangent vectors at the knots of a group, and the derivatives by which they are multiplied. */
typedef lanes tangent_at_knots[TANGENT + GROWTH_DERIVATIVES];

#ifdef EIGHT_COORDINATES
#define APART __attribute__((noinline)) /* of many numbers, which would take registers from the caller */
#else
#define APART inline
#endif

/* Lanes of a group of columns. */
static inline lanes columns_of(const double *row, int group)
{
  lanes x;
  memcpy(&x, row + group * LANES, sizeof x);
  return x;
}

/* x plus the sums over `rows` values in memory, of which LANES are contiguous and then `apart` apart, times a table. */
static inline lanes add_rows(
    lanes x, const double (*table)[COLUMNS], int rows, int group, const double *value, int apart)
{
  lanes sum[2] = {x, lanes_of(0.0)};
#pragma GCC unroll 16
  for (int j = 0; j < rows; j++)
    sum[j % 2] += value[j / LANES * apart + j % LANES] * columns_of(table[j], group);
  return sum[0] + sum[1];
}

/* Values at the knots of a group from those at the points, of which LANES are contiguous and then `apart` apart. */
static inline lanes at_knots(int part, int group, const double *value, int apart)
{
#ifndef KNOTS_ARE_POINTS
  return add_rows(lanes_of(0.0), KNOT_VALUES + part * KEPT, KEPT, group, value, apart);
#else
  (void)part;
  return columns_of(value + group * (apart - LANES), group);
#endif
}

#ifdef VARIABLE_ACCELERATIONS
typedef struct {
  tangent_at_knots u[KNOT_GROUPS];
  lanes mass[KNOT_GROUPS][MASS];
  double square, inverse; /* h^2, 1 / h */
} tangent_knots;

/* Computes the derivatives of the accelerations at the knots of a part of a step, with the velocities of the run. */
static APART void linearise_accelerations(const run_memory *run, const step_data *step, const iteration_data *data,
    coordinates *X, int part, double h, tangent_knots *at)
{
  const double inverse = 1.0 / step->h;
  lanes u[3 * M];
  (void)X, (void)data;
  at->square = h * h;
  at->inverse = 1.0 / h;
  for (int n = 0; n < KNOT_GROUPS; n++) {
    for (int i = 0; i < M; i++) {
      const double *V = run->memory + i * POINTS;
      u[i] = step->q0[i] + step->h * add_rows(lanes_of(0.0), KNOT_INTEGRALS + part * KEPT, KEPT, n, V, LANES);
      u[M + i] = at_knots(part, n, V, LANES);
      u[2 * M + i] = inverse * add_rows(lanes_of(0.0), KNOT_RATES + part * KEPT, KEPT, n, V, LANES);
    }
    memset(at->mass[n], 0, sizeof at->mass[n]);
    point_derivatives(u, step->t + step->h * columns_of(KNOT_ABSCISSA[part], n), step->parameters, at->u[n] + TANGENT,
        at->mass[n]);
    factor_mass(at->mass[n]);
  }
}

/* Accelerations times h^2 of the tangent vectors at the knots of a group. */
static APART void tangent_accelerations(const step_data *step, const tangent_knots *at, int n, lanes *a)
{
  derivative_product(at->u[n], lanes_of(step->t), step->parameters, a);
  solve_mass(at->mass[n], a);
  for (int i = 0; i < M; i++)
    a[i] *= at->square;
}
#else
typedef struct {
  tangent_at_knots u[KNOT_GROUPS];
  double unit[M]; /* h^2 / m */
} tangent_knots;

static APART void linearise_accelerations(const run_memory *run, const step_data *step, const iteration_data *data,
    coordinates *X, int part, double h, tangent_knots *at)
{
  lanes u[M];
  const double *x = (const double *)X;
  (void)run;
  for (int n = 0; n < KNOT_GROUPS; n++) {
    for (int i = 0; i < M; i++)
      u[i] = at_knots(part, n, x + i * LANES, M * LANES);
    point_derivatives(
        u, step->t + step->h * columns_of(KNOT_ABSCISSA[part], n), step->parameters, at->u[n] + TANGENT);
  }
  for (int i = 0; i < M; i++)
    at->unit[i] = h * h * data->inverse_mass[i];
}

static APART void tangent_accelerations(const step_data *step, const tangent_knots *at, int n, lanes *a)
{
  derivative_product(at->u[n], lanes_of(step->t), step->parameters, a);
  for (int i = 0; i < M; i++)
    a[i] *= at->unit[i];
}
#endif

/* Tangent vectors at the knots by Taylor's polynomial with coefficients s, and its accelerations. */
static inline void begin_tangents(double (*s)[8], lanes (*a)[M], tangent_knots *at)
{
  for (int n = 0; n < KNOT_GROUPS; n++) {
    const lanes c = columns_of(KNOT_ABSCISSA[0], n);
    for (int i = 0; i < M; i++) {
      at->u[n][i] = s[i][0] + c * (s[i][1] + c * (s[i][2] + c * (s[i][3] + c * s[i][4])));
#ifdef VARIABLE_ACCELERATIONS
      at->u[n][M + i] = at->inverse * (s[i][1] + c * (2.0 * s[i][2] + c * (3.0 * s[i][3] + c * (4.0 * s[i][4]))));
#endif
      a[n][i] = 2.0 * s[i][2] + c * (6.0 * s[i][3] + c * (12.0 * s[i][4]));
    }
  }
}

/* Tangent vectors at the knots from accelerations. */
static inline void place_tangents(double (*s)[8], double (*a)[KNOTS_STORED], tangent_knots *at)
{
  for (int n = 0; n < KNOT_GROUPS; n++)
    for (int i = 0; i < M; i++) {
      const lanes linear = s[i][0] + columns_of(KNOT_ABSCISSA[0], n) * s[i][1];
      at->u[n][i] = add_rows(linear, TANGENT_INTEGRALS_TWICE, KNOTS, n, a[i], LANES);
#ifdef VARIABLE_ACCELERATIONS
      at->u[n][M + i] = at->inverse * add_rows(lanes_of(s[i][1]), TANGENT_INTEGRALS, KNOTS, n, a[i], LANES);
#endif
    }
}

/* Coefficients at the end of the step from accelerations; loads of several stores at once would wait for them. */
static inline void end_tangents(double (*s)[8], double (*a)[KNOTS_STORED])
{
  static const double q[COLUMNS] = {1.0}, v[COLUMNS] = {1.0, 1.0};
  for (int i = 0; i < M; i++) {
    const double of_q = s[i][0], of_v = s[i][1];
    for (int n = 0; n < COLUMNS / LANES; n++) {
      const lanes linear = of_q * columns_of(q, n) + of_v * columns_of(v, n);
      const lanes end = add_rows(linear, TANGENT_END, KNOTS, n, a[i], LANES);
      memcpy(s[i] + n * LANES, &end, sizeof end);
    }
  }
}

/* Converts the coefficients to another step size, always: jumps that depend on whether it is another one cost more. */
static inline void rescale_tangent(run_memory *run, double h)
{
  const double ratio = h / run->tangent_h, square = ratio * ratio;
  const double power[TAYLOR] = {1.0, ratio, square, ratio * square, square * square};
  for (int i = 0; i < M; i++)
    for (int k = 1; k < TAYLOR; k++)
      run->tangent[i][k] *= power[k];
  run->tangent_h = h;
}

/* Advances the tangent vector by a step, of size h, or by one of its halves (part 1 or 2); ends the measurement if the
 * iterations diverge. */
static inline void advance_tangent(
    run_memory *run, const step_data *step, const iteration_data *data, coordinates *X, int part, double h)
{
  double size = 0.0, rate = 0.0, change, stored[M][KNOTS_STORED];
  int k = 0, is_resolved = 0;
  tangent_knots at;
  lanes a[KNOT_GROUPS][M], before[KNOT_GROUPS][M];
  rescale_tangent(run, h);
  for (int i = 0; i < M; i++) {
    const double *of = run->tangent[i];
    size += of[0] * of[0] + 0.25 * (of[1] * of[1]);
    rate += 4.0 * (of[2] * of[2]) + 36.0 * (of[3] * of[3]);
  }
  linearise_accelerations(run, step, data, X, part, h, &at);
  begin_tangents(run->tangent, a, &at);
  while (!is_resolved && k++ < MOST_ITERATIONS) {
    lanes sum = lanes_of(0.0);
    if (k > 1)
      place_tangents(run->tangent, stored, &at);
    memcpy(before, a, sizeof before);
    for (int n = 0; n < KNOT_GROUPS; n++) {
      tangent_accelerations(step, &at, n, a[n]);
      for (int i = 0; i < M; i++) {
        sum += (a[n][i] - before[n][i]) * (a[n][i] - before[n][i]);
        memcpy(stored[i] + n * LANES, &a[n][i], sizeof(lanes));
      }
    }
    IN_MEMORY(stored);
    change = lanes_total(sum) * (1.0 / KNOTS_STORED);
    is_resolved = IS_SMALL(change, k, size, rate);
  }
  if (!is_resolved)
    run->measures_growth = run->growth_samples = 0;
  end_tangents(run->tangent, stored);
}

/* Logarithm to base 2, linear between powers of two: less than .09 too small; 0 below normal numbers. */
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
  lanes F[GROUPS][M]; /* forces, or velocities */
  lanes_load(run->memory, F);
#ifdef VARIABLE_ACCELERATIONS
  (void)data, (void)dp;
  for (int i = 0; i < M; i++)
    v[i] = weigh(AT_END, F, i);
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
    by_q[i] = -weigh(AT_END, F, i);
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
  const double inverse = 1.0 / run->tangent_h;
  double q[M], v[M], tangent_v[M], by_q[M], by_v[M], q2 = 0.0, v2 = 0.0, dq2 = 0.0, dv2 = 0.0;
  double size, growth, logarithm_q;
#ifdef ENERGY_CONSERVED
  double along = 0.0, square = 0.0;
#endif
  for (int i = 0; i < M; i++) {
    q[i] = step->q0[i] + dq[i];
    tangent_v[i] = inverse * run->tangent[i][1];
  }
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
  for (int i = 0; i < M; i++)
    square += by_q[i] * by_q[i] * q2 + by_v[i] * by_v[i] * v2;
  square = 1.0 / square; /* before the tangent vector is known, for which the next step waits */
  for (int i = 0; i < M; i++)
    along += by_v[i] * tangent_v[i] + by_q[i] * run->tangent[i][0];
  along *= square;
  for (int i = 0; i < M; i++) {
    run->tangent[i][0] -= along * q2 * by_q[i];
    tangent_v[i] -= along * v2 * by_v[i];
    run->tangent[i][1] = run->tangent_h * tangent_v[i];
  }
#endif
  for (int i = 0; i < M; i++) {
    dq2 += run->tangent[i][0] * run->tangent[i][0];
    dv2 += tangent_v[i] * tangent_v[i];
  }
  logarithm_q = logarithm(q2);
  size = larger(logarithm(dq2), logarithm(dv2) + logarithm_q - logarithm(v2));
  growth = 0.5 * LOG_2 * (size - logarithm_q);
  size *= 0.5 * LOG_2;
  run->growth = run->growth_samples > 0 ? larger(run->growth, growth) : growth;
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
  if (run->tangent_steps == 0) {
    run->tangent_h = step->h;
#ifdef VARIABLE_ACCELERATIONS
    lanes V[GROUPS][M];
    lanes_load(run->memory, V);
#endif
    for (int i = 0; i < M; i++) {
      run->growth_start[i] = step->q0[i];
      run->tangent[i][0] = INITIAL(step->q0[i], dq[i]) * cos(i);
#ifdef VARIABLE_ACCELERATIONS
      run->tangent[i][1] = INITIAL(step->h * at_first(&V[0][i]), dq[i]) * cos(i + 1);
#else
      run->tangent[i][1] = INITIAL(step->h * data->inverse_mass[i] * step->p0[i], dq[i]) * cos(i + 1);
#endif
    }
  }
  if (run->measures_growth < OF_SMALL_STEPS && KNOTS <= 4) {
    advance_tangent(run, step, data, X, 1, 0.5 * step->h);
    advance_tangent(run, step, data, X, 2, 0.5 * step->h);
  } else
    advance_tangent(run, step, data, X, 0, step->h);
  if (run->measures_growth && (run->tangent_steps++ & (run->measures_growth - 1)) == 0)
    sample_growth(run, step, data, dq, dp);
}
