#include "../iteration/separable_iteration.h"

/* Step in double-double arithmetic by mixed precision. separable_iteration.h solves the stage equations in double, to
 * 1e-16; their residual in pairs, r = q0 + h c v0 + h^2 A F(X) / m - X, has 16 digits as one word, so that the
 * correction D = r + h^2 A F_q(X) D / m, solved in double by fixed-point iteration, makes X accurate to 32 digits. Two
 * evaluations of the forces in pairs are enough: those of the residual and those at X + D. What the linear equation
 * omits, e = F(X + D) - F(X) - F_q D, is quadratic in D: a bias of 1e-32, from which the energy would drift. It changes
 * the points by D' = h^2 A (e + F_q D') / m, in double, and the forces by F_q D'. Requires: the kernels
 * force_lanes_pairs, mass_pairs, point_derivatives and derivative_product. */

#define CORRECTED 1e-34 /* last change of D, relative to the state */
#define CORRECTED_BIAS 0.05 /* last change of D', relative to itself */
#define SMALLEST_SIZE 1e-280 /* of a coordinate; 1e15 times its inverse is finite */
#define CORRECTED_ROUNDING 1e-15 /* changes relative to the residual that may be rounding errors; ten times these are */
#define MOST_CORRECTIONS 200

/* Arguments of a step, and its points. */
typedef struct {
  dd t, h, square, inverse_mass[M], drift[M]; /* h^2; h v */
  double scale[M], inverse_size[M]; /* scale: h^2 / m */
  const double *parameters;
  ddl X[GROUPS][M], F[GROUPS][M], base[GROUPS][M]; /* base: points without forces */
  ddl first[GROUPS][M]; /* forces at X */
  lanes rest[GROUPS][M], vector[GROUPS][M + POINT_DERIVATIVES]; /* vector: D, then the derivatives */
} pair_step;

static inline double lane_of(const lanes *x, int j)
{
  double value; /* a cast of the pointer would alias */
  memcpy(&value, (const char *)x + (size_t)j * sizeof value, sizeof value);
  return value;
}

/* sum_j table_gj x_j of a coordinate: Dot2 (Ogita, Rump & Oishi 2005) with the low words of both factors. Tables have
 * three words: those of two are of another method, which is not symplectic, so that the energy would drift by 3e-35 a
 * step, more in a million steps than the random walk of rounding errors. */
static inline ddl sum_of_pairs(const lanes *table, const lanes *low, const lanes *lowest, int g, const ddl (*x)[M],
    int i)
{
  ddl sum[2] = {{{0.0}, {0.0}}, {{0.0}, {0.0}}};
#pragma GCC unroll 16
  for (int j = 0; j < POINTS; j++) {
    const lanes a = table[j * GROUPS + g], b = low[j * GROUPS + g];
    const ddl *at = &x[j / LANES][i];
    const lanes high = lanes_of(lane_of(&at->high, j % LANES)), rest = lanes_of(lane_of(&at->low, j % LANES));
    const ddl product = ddl_two_product(a, high), next = ddl_two_sum(sum[j % 2].high, product.high);
    sum[j % 2].high = next.high;
    const lanes lower = multiply_add(a, rest, multiply_add(b, high, lowest[j * GROUPS + g] * high));
    sum[j % 2].low += lower + (product.low + next.low);
  }
  const ddl both = ddl_two_sum(sum[0].high, sum[1].high);
  return ddl_fast_two_sum(both.high, both.low + (sum[0].low + sum[1].low));
}

/* x + y with an unnormalised low word: the sum of the low words and the rounding error. */
static inline ddl add_loosely(ddl x, ddl y)
{
  ddl sum = ddl_two_sum(x.high, y.high);
  sum.low += x.low + y.low;
  return sum;
}

/* Sum over all points, in an order that does not depend on the vector length. */
static inline dd total_of_pairs(ddl *x)
{
  enum { WHOLE = (POINTS & -POINTS) / LANES };
  for (int n = WHOLE; n < GROUPS; n++)
    x[n % WHOLE] = add_loosely(x[n % WHOLE], x[n]);
  for (int half = WHOLE / 2; half > 0; half /= 2)
    for (int n = 0; n < half; n++)
      x[n] = add_loosely(x[n], x[n + half]);
  ddl sum = x[0];
  for (int half = LANES / 2; half > 0; half /= 2) {
    lane_view high = {sum.high}, low = {sum.low};
    for (int j = 0; j < half; j++) {
      high.lane[j] = high.lane[j + half];
      low.lane[j] = low.lane[j + half];
    }
    const ddl other = {high.all, low.all};
    sum = add_loosely(sum, other);
  }
  return dd_fast_two_sum(lane_of(&sum.high, 0), lane_of(&sum.low, 0));
}

static inline dd weighted_total(const lanes *weights, const lanes *low, const lanes *lowest, const ddl (*x)[M], int i)
{
  ddl part[GROUPS];
  for (int n = 0; n < GROUPS; n++) {
    part[n] = ddl_two_product(weights[n], x[n][i].high);
    const lanes lower = multiply_add(low[n], x[n][i].high, lowest[n] * x[n][i].high);
    part[n].low += multiply_add(weights[n], x[n][i].low, lower);
  }
  return total_of_pairs(part);
}

static inline void forces_of_pairs(pair_step *w)
{
  for (int n = 0; n < GROUPS; n++) {
    const ddl part = {ABSCISSA[n], ABSCISSA_LOW[n]};
    force_lanes_pairs(w->X[n], ddl_add(ddl_of(w->t), ddl_multiply(part, ddl_of(w->h))), w->parameters, w->F[n]);
  }
}

static void begin_pairs(pair_step *w, const step_data *step, double t_low, double h_low)
{
  const dd h = dd_of(step->h, h_low);
  dd masses[M];
  lanes X[GROUPS][M];
  w->t = dd_of(step->t, t_low);
  w->h = h;
  w->square = dd_multiply(h, h);
  w->parameters = step->parameters;
  memcpy(X, step->points, sizeof X);
  mass_pairs(NULL, w->t, step->parameters, masses);
  for (int i = 0; i < M; i++) {
    const dd q = dd_of(step->q0[i], step->carry_q[i]), p = dd_of(step->p0[i], step->carry_p[i]);
    double farthest = fabs(q.high);
    w->inverse_mass[i] = dd_divide(dd_of(1.0, 0.0), masses[i]);
    w->drift[i] = dd_multiply(dd_multiply(p, w->inverse_mass[i]), h);
    w->scale[i] = w->square.high * w->inverse_mass[i].high;
    w->inverse_size[i] = fabs(w->drift[i].high);
    for (int n = 0; n < GROUPS; n++) {
      const ddl node = {DRIFT[n], DRIFT_LOW[n]};
      const ddl drift = ddl_of(w->drift[i]), product = ddl_two_product(node.high, drift.high);
      const lanes lower = multiply_add(node.low, drift.high, DRIFT_LOWEST[n] * drift.high);
      const ddl moved = ddl_fast_two_sum(product.high, product.low + multiply_add(node.high, drift.low, lower));
      w->base[n][i] = ddl_add(ddl_of(q), moved);
      w->X[n][i] = ddl_word(X[n][i]);
      for (int j = 0; j < LANES; j++) /* at rest in the origin, q and p are 0 */
        farthest = larger(farthest, fabs(lane_of(&X[n][i], j)));
    }
    w->inverse_size[i] += farthest;
  }
  const double largest = largest_number(w->inverse_size);
  for (int i = 0; i < M; i++)
    w->inverse_size[i] = 1.0 / (w->inverse_size[i] + 1e-3 * largest + SMALLEST_SIZE);
}

/* Residual of the stage equations, as one word; X has one, so that its difference from the high word is exact. */
static inline void find_residual(pair_step *w)
{
  for (int i = 0; i < M; i++)
    for (int n = 0; n < GROUPS; n++) {
      const dd unit = dd_multiply(w->square, w->inverse_mass[i]);
      const ddl sum = sum_of_pairs(PRODUCT, PRODUCT_LOW, PRODUCT_LOWEST, n, w->F, i);
      const ddl moved = ddl_multiply(sum, ddl_of(unit)), point = ddl_two_sum(w->base[n][i].high, moved.high);
      const lanes low = (point.low - w->X[n][i].low) + (w->base[n][i].low + moved.low);
      w->rest[n][i] = (point.high - w->X[n][i].high) + low;
    }
}

static inline void find_derivatives(pair_step *w)
{
  for (int n = 0; n < GROUPS; n++) {
    lanes X[M];
    for (int i = 0; i < M; i++)
      X[i] = w->X[n][i].high;
    point_derivatives(X, w->t.high + w->h.high * ABSCISSA[n], w->parameters, w->vector[n] + M);
  }
}

/* Solves for the correction D, which starts as the residual, to a part of it or to CORRECTED; f: F_q D. */
static inline int find_correction(pair_step *w, double part, lanes (*f)[M])
{
  double last = INFINITY, size = 0.0; /* size of the residual */
  for (int n = 0; n < GROUPS; n++)
    for (int i = 0; i < M; i++) {
      w->vector[n][i] = w->rest[n][i];
      for (int j = 0; j < LANES; j++)
        size = larger(size, fabs(lane_of(&w->rest[n][i], j)) * w->inverse_size[i]);
    }
  const double least = larger(part * size, CORRECTED);
  for (int k = 0; k < MOST_CORRECTIONS; k++) {
    lanes moved[GROUPS] = {{0.0}};
    for (int n = 0; n < GROUPS; n++)
      derivative_product(w->vector[n], lanes_of(w->t.high), w->parameters, f[n]);
    for (int i = 0; i < M; i++)
      for (int n = 0; n < GROUPS; n++) {
        const lanes next = w->rest[n][i] + w->scale[i] * apply(PRODUCT, n, f, i);
        const lanes change = (next - w->vector[n][i]) * (1e15 * w->inverse_size[i]); /* squares are normal */
        moved[n] = moved[n] + change * change;
        w->vector[n][i] = next;
      }
    const double change = sqrt(points_total(moved)) / 1e15, rate = change / last;
    if (!is_finite(change))
      return NOT_FINITE;
    if (change <= least || (k > 0 && rate < 0.5 && change * rate <= least))
      return OK;
    /* rounding errors of D, which stop the decrease; they matter in the 32nd digit of the state at most */
    if (rate > 0.5 && change <= larger(CORRECTED_ROUNDING * size * (rate > 0.9 ? 10.0 : 1.0), least))
      return OK;
    last = change;
  }
  return NOT_CONVERGED;
}

/* Moves the points by D, of the products f, and finds the forces there and the effect of what is quadratic in D. */
static inline int correct_forces(pair_step *w, lanes (*f)[M])
{
  memcpy(w->first, w->F, sizeof w->F);
  for (int n = 0; n < GROUPS; n++)
    for (int i = 0; i < M; i++)
      w->X[n][i] = ddl_two_sum(w->X[n][i].high, w->vector[n][i]);
  forces_of_pairs(w);
  for (int n = 0; n < GROUPS; n++)
    for (int i = 0; i < M; i++)
      f[n][i] = ddl_subtract(w->F[n][i], w->first[n][i]).high - f[n][i];
  for (int n = 0; n < GROUPS; n++)
    for (int i = 0; i < M; i++)
      w->rest[n][i] = w->scale[i] * apply(PRODUCT, n, f, i);
  const int status = find_correction(w, CORRECTED_BIAS, f);
  for (int n = 0; n < GROUPS; n++)
    for (int i = 0; i < M; i++)
      w->F[n][i] = ddl_add(w->F[n][i], ddl_word(f[n][i]));
  return status;
}

/* Replaces the increments of a step, solved in double, by those in two words. On failure they are undefined. */
HOT int refine_increments(const step_data *step, double *memory, double t_low, double h_low, double *dq, double *dp,
    double *passed, double *workspace)
{
  pair_step w;
  lanes f[GROUPS][M];
  int status;
  (void)memory, (void)passed, (void)workspace;
  begin_pairs(&w, step, t_low, h_low);
  forces_of_pairs(&w);
  find_residual(&w);
  find_derivatives(&w);
  status = find_correction(&w, 0.0, f);
  status = status == OK ? correct_forces(&w, f) : status;
  if (status != OK)
    return status;
  for (int i = 0; i < M; i++) {
    const dd unit = dd_multiply(w.square, w.inverse_mass[i]);
    const dd bend = weighted_total(POINT_END_POSITION, POINT_END_POSITION_LOW, POINT_END_POSITION_LOWEST, w.F, i);
    const dd push = weighted_total(POINT_END_MOMENTUM, POINT_END_MOMENTUM_LOW, POINT_END_MOMENTUM_LOWEST, w.F, i);
    const dd q = dd_add(w.drift[i], dd_multiply(bend, unit)), p = dd_multiply(push, w.h);
    dq[i] = q.high, dq[M + i] = q.low, dp[i] = p.high, dp[M + i] = p.low;
  }
  return all_finite(dq, 2 * M) && all_finite(dp, 2 * M) ? OK : NOT_FINITE;
}
