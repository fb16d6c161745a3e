#include "../run/run.h"

/* Error of the positions along a run: a tangent vector rho = (dq, dv) that starts at zero and is carried by each step
 * phi, while the errors that the step makes are added,
 *   rho' = D phi(x) (rho + d) - d + r,      d_i = +-.42 u |q_i|,      r_i = +-max(u, c tolerance) |dq_i|,
 * d the rounding of the positions at which forces are evaluated, r the error of the step (of positions alone), with
 * random signs. The largest |rho_i| relative to the range of q_i in the run estimates the error of the run, also where
 * a motion amplifies errors; it depends neither on the origin nor on a gauge.
 *
 * D phi is that of the variational equations along each accepted step,
 *   dq'' = F_q dq / m,      or      L_vv dq'' = -E_q dq - E_v dv   (VARIABLE_ACCELERATIONS),
 * with E(q, v, a) the Euler-Lagrange residual at knots c_n h, which are as many Gauss points as those of the step, so
 * that the map is symplectic; derivatives there are evaluated in SIMD lanes. The collocation equations
 *   dq_n = dq + c_n h dv + h^2 sum_j P_nj dq''_j,      dv_n = dv + h sum_j Q_nj dq''_j
 * are solved by Picard iterations (Hairer, Norsett & Wanner, Solving ODEs I, sec. I.8) from Taylor's polynomial at the
 * end of the step before. Requires: the iteration, tables, the numbers GROWTH_DERIVATIVES of distinct derivatives at a
 * point and PART_OF_TOLERANCE, c, the kernels point_derivatives and derivative_product. */

#define LARGEST_SQUARE 1e140 /* of sizes: the products of two are numbers */
#define MOST_ITERATIONS 30

/* One in so many steps adds the errors of all, times the root of their number, since signs are random. */
#define STEPS_OF_ERRORS 8
#define LARGE_STEPS_OF_ERRORS 2 /* where the tolerance exceeds LARGE_TOLERANCE */
#define LARGE_TOLERANCE 1e-7
#define ROUNDING (0.42 * (REAL_EPSILON / 2)) /* relative, in the mean: u / sqrt(3) for 1, half of it below 2 */
#define TEN_DIGITS 1e-10 /* ten digits are left: no warning, nor.. */
#define FAR_ABOVE 1e4 /* .. where the tolerance is exceeded by less, */
#define MEANINGLESS 1e-2 /* but always beyond this error */
#define MOVES 512.0 /* in units of rounding: coordinates that move by less have the size of the largest one */

/* An iteration ends if its change of h^2 dq'' leaves errors that are small beside the vector, by squares: where limits
 * are larger, regular orbits of large steps show exponential growth, and encounters too much of it. */
#ifdef VARIABLE_ACCELERATIONS
enum { TANGENT = 2 * M }; /* numbers of a tangent vector on which accelerations depend */
#define SMALL 4.8e-7
#else
enum { TANGENT = M };
#define SMALL 1e-8
#endif

/* Taylor's coefficients h^k dq^(k) / k!, k < 5, or the knots are columns of the tables: whole vectors of any length. */
enum { TAYLOR = 5,
  COEFFICIENTS = 8,
  COLUMNS = (KNOTS + 7) / 8 * 8,
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
static inline lanes at_knots(int group, const double *value, int apart)
{
#ifndef KNOTS_ARE_POINTS
  return add_rows(lanes_of(0.0), KNOT_VALUES, KEPT, group, value, apart);
#else
  return columns_of(value + group * (apart - LANES), group);
#endif
}

#ifdef VARIABLE_ACCELERATIONS
typedef struct {
  tangent_at_knots u[KNOT_GROUPS];
  lanes mass[KNOT_GROUPS][MASS];
  double square, inverse; /* h^2, 1 / h */
} tangent_knots;

/* Computes the derivatives of the accelerations at the knots of a step, with the velocities of the run. */
static APART void linearise_accelerations(const run_memory *run, const step_data *step, const iteration_data *data,
    coordinates *X, tangent_knots *at)
{
  const double inverse = 1.0 / step->h;
  lanes u[3 * M];
  (void)X, (void)data;
  at->square = step->h * step->h;
  at->inverse = inverse;
  for (int n = 0; n < KNOT_GROUPS; n++) {
    for (int i = 0; i < M; i++) {
      const double *V = run->memory + i * POINTS;
      u[i] = step->q0[i] + step->h * add_rows(lanes_of(0.0), KNOT_INTEGRALS, KEPT, n, V, LANES);
      u[M + i] = at_knots(n, V, LANES);
      u[2 * M + i] = inverse * add_rows(lanes_of(0.0), KNOT_RATES, KEPT, n, V, LANES);
    }
    memset(at->mass[n], 0, sizeof at->mass[n]);
    point_derivatives(u, step->t + step->h * columns_of(KNOT_ABSCISSA[0], n), step->parameters, at->u[n] + TANGENT,
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
    coordinates *X, tangent_knots *at)
{
  lanes u[M];
  const double *x = (const double *)X;
  (void)run;
  for (int n = 0; n < KNOT_GROUPS; n++) {
    for (int i = 0; i < M; i++)
      u[i] = at_knots(n, x + i * LANES, M * LANES);
    point_derivatives(
        u, step->t + step->h * columns_of(KNOT_ABSCISSA[0], n), step->parameters, at->u[n] + TANGENT);
  }
  for (int i = 0; i < M; i++)
    at->unit[i] = step->h * step->h * data->inverse_mass[i];
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
  static const double q[COEFFICIENTS] = {1.0}, v[COEFFICIENTS] = {1.0, 1.0};
  for (int i = 0; i < M; i++) {
    const double of_q = s[i][0], of_v = s[i][1];
    for (int n = 0; n < COEFFICIENTS / LANES; n++) {
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

/* Ends the measurement by numbers that are too large to be squared: of errors beyond the motion, or of the motion. */
static inline void end_measurement(run_memory *run)
{
  int beyond = 0;
  for (int i = 0; i < M; i++)
    beyond |= !(fabs(run->tangent[i][0]) <= run->highest[i] - run->lowest[i]);
  run->growth = INFINITY;
  run->tangent_steps = beyond ? run->tangent_steps : 0;
  run->measures_growth = 0;
}

/* Advances the tangent vector by a step; ends the measurement if the iterations diverge. */
static inline void advance_tangent(
    run_memory *run, const step_data *step, const iteration_data *data, coordinates *X)
{
  double size = 0.0, change, stored[M][KNOTS_STORED];
  int k = 0, is_resolved = 0;
  tangent_knots at;
  lanes a[KNOT_GROUPS][M], before[KNOT_GROUPS][M];
  rescale_tangent(run, step->h);
  for (int i = 0; i < M; i++) {
    const double *of = run->tangent[i];
    size += of[0] * of[0] + 0.25 * (of[1] * of[1]);
  }
  linearise_accelerations(run, step, data, X, &at);
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
    is_resolved = change <= SMALL * size;
  }
  if (!is_resolved)
    run->measures_growth = run->tangent_steps = 0;
  end_tangents(run->tangent, stored);
  if (!(size < LARGEST_SQUARE))
    end_measurement(run);
}

/* x with the sign of the lowest bit. */
static inline double with_sign(double x, unsigned long long bits)
{
  unsigned long long of;
  memcpy(&of, &x, sizeof of);
  of ^= bits << 63;
  memcpy(&x, &of, sizeof of);
  return x;
}

/* Adds the rounding d of the positions at the start of the step, for a number of steps whose root is `walk`. */
static inline void add_rounding(run_memory *run, const step_data *step, double walk, double *rounding)
{
  unsigned long long bits = (unsigned long long)run->signs;
  bits ^= bits << 13, bits ^= bits >> 7, bits ^= bits << 17; /* xorshift (Marsaglia 2003) */
  run->signs = (long long)bits;
  for (int i = 0; i < M; i++) {
    rounding[i] = with_sign(ROUNDING * walk * step->q0[i], bits >> i % 24);
    run->tangent[i][0] += rounding[i];
  }
}

/* Replaces that rounding by the error r of the step, and compares rho with the ranges of the motion so far. */
static inline void add_error(run_memory *run, const step_data *step, const double *dq, double error,
    const double *rounding, double tolerance)
{
  double size[M], largest = 0.0, ratio = 0.0;
  for (int i = 0; i < M; i++) {
    const double q = step->q0[i] + dq[i];
    run->tangent[i][0] += with_sign(error * dq[i], (unsigned long long)run->signs >> (24 + i % 24)) - rounding[i];
    run->largest_error[i] = larger(run->largest_error[i], fabs(run->tangent[i][0]));
    run->lowest[i] = q < run->lowest[i] ? q : run->lowest[i];
    run->highest[i] = larger(run->highest[i], q);
    size[i] = run->highest[i] - run->lowest[i];
  }
  enlarge_to_arrays(size);
  for (int i = 0; i < M; i++)
    largest = larger(largest, size[i]);
  for (int i = 0; i < M; i++) {
    const double value = larger(largest, larger(fabs(run->highest[i]), fabs(run->lowest[i])));
    size[i] = size[i] > MOVES * (REAL_EPSILON / 2) * value ? size[i] : largest + DBL_MIN;
    ratio = larger(ratio, run->largest_error[i] / size[i]);
  }
  run->growth = ratio;
  run->growth_limit = smaller(larger(TEN_DIGITS, FAR_ABOVE * tolerance), MEANINGLESS);
  if (ratio <= run->growth_limit)
    run->accurate_until = step->t + step->h;
  if (ratio <= MEANINGLESS)
    run->meaningful_until = step->t + step->h;
}

/* Advances the error rho by an accepted step with increments dq; the first steps and the last one add errors. */
static __attribute__((noinline)) void measure_growth(run_memory *run, const step_data *step, const solver_data *data,
    coordinates *X, const double *dq, double tolerance, int last)
{
  const long long since = run->tangent_steps - run->added;
  const int most = tolerance > LARGE_TOLERANCE ? LARGE_STEPS_OF_ERRORS : STEPS_OF_ERRORS;
  const int adds = since >= most || run->tangent_steps < STEPS_OF_ERRORS || last;
  const double walk = adds ? sqrt((double)(since > 0 ? since : 1)) : 0.0;
  double rounding[M];
  if (run->tangent_steps == 0) {
    run->tangent_h = step->h;
    run->signs = 0x1E3779B97F4A7C15LL;
    run->accurate_until = run->meaningful_until = step->t;
    for (int i = 0; i < M; i++)
      run->lowest[i] = run->highest[i] = step->q0[i];
  }
  if (adds)
    add_rounding(run, step, walk, rounding);
  advance_tangent(run, step, data, X);
  if (!run->measures_growth)
    return;
  if (adds) {
    add_error(run, step, dq, larger(REAL_EPSILON / 2, PART_OF_TOLERANCE * tolerance) * walk, rounding, tolerance);
    run->added = run->tangent_steps;
  }
  run->tangent_steps++;
}
