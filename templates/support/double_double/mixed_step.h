#include "../iteration/separable_iteration.h"

/* Step in double-double arithmetic by mixed precision. separable_iteration.h solves the stage equations in double, to
 * 1e-16; their residual in pairs, r = q0 + h c v0 + h^2 A F(X) / m - X, has 16 digits as one word, so that the
 * correction D = r + h^2 A (F_q D + e) / m, solved in double by fixed-point iteration, makes X accurate to 32 digits,
 * and so the forces F(X) + F_q D + e. As soon as D has two digits, a second evaluation of the forces in pairs gives e =
 * F(X + D) - F(X) - F_q D, what is quadratic in D: a bias of 1e-32, from which the energy would drift. Rounded tables
 * in double have a bias in D of 1e-16 of its own, so that the iteration in double has their low words, too. Requires:
 * the kernels force_lanes_pairs, mass_pairs, point_derivatives and derivative_product; ANCHOR. */

#define CORRECTED 2e-33 /* last change of D, relative to the state */
#define CORRECTED_ROUNDING 1e-15 /* changes relative to the residual that may be rounding errors; ten times these are */
#define CURVED 1e-2 /* changes relative to the residual at which e is computed */
#define SCALE 1e15 /* of changes, whose squares are normal numbers then */
#define SMALLEST_SIZE 1e-280 /* of a coordinate; 1e15 times its inverse is finite */
#define MOST_CORRECTIONS 200

/* Arguments of a step, and its points. */
typedef struct {
  dd t, h, drift[M], unit[M]; /* h v; h^2 / m */
  double inverse_size[M], anchor[M];
  const double *parameters;
  coordinates X[GROUPS], rest[GROUPS];
  ddl F[GROUPS][M];
  lanes vector[GROUPS][M + POINT_DERIVATIVES]; /* D, then the derivatives */
} pair_step;

static inline double lane_of(const lanes *x, int j)
{
  double value; /* a cast of the pointer would alias */
  memcpy(&value, (const char *)x + (size_t)j * sizeof value, sizeof value);
  return value;
}

/* Largest absolute value at the points. */
static inline double largest_at_points(const ddl (*x)[M], int i)
{
  lane_view largest = {larger_lanes(x[0][i].high, -x[0][i].high)};
  for (int n = 1; n < GROUPS; n++)
    largest.all = larger_lanes(largest.all, larger_lanes(x[n][i].high, -x[n][i].high));
  for (int half = LANES / 2; half > 0; half /= 2)
    for (int j = 0; j < half; j++)
      largest.lane[j] = larger(largest.lane[j], largest.lane[j + half]);
  return largest.lane[0];
}

/* sum_j table_gj x_j of a coordinate. The sum begins with a large number, the anchor, so that all partial sums have the
 * same unit and are exact, and so is the sum of what they omit of the products (Rump, Ogita & Oishi 2008). Tables have
 * three words: those of two are of another method, which is not symplectic, so that the energy would drift by 3e-35 a
 * step, more in a million steps than the random walk of rounding errors. The third word is added to a product: in a sum
 * it would be less than half a unit of the others. */
static inline ddl sum_of_pairs(const lanes *table, const lanes *low, const lanes *lowest, int g, const ddl (*x)[M],
    int i, double anchor)
{
  lanes sum = lanes_of(anchor), omitted = lanes_of(0.0), low_sum = omitted, lower_sum = omitted;
#pragma GCC unroll 32
  for (int j = 0; j < COLUMNS; j++) {
    const ddl *at = &x[j / LANES][i];
    const lanes a = table[j * GROUPS + g], high = lanes_of(lane_of(&at->high, j % LANES));
    const ddl product = ddl_two_product(a, high);
    const lanes next = sum + product.high;
    omitted += product.high - (next - sum);
    low_sum += product.low;
    lower_sum += multiply_add(a, lanes_of(lane_of(&at->low, j % LANES)),
        multiply_add(low[j * GROUPS + g], high, lowest[j * GROUPS + g] * high));
    sum = next;
  }
  const ddl exact = ddl_two_sum(sum - anchor, omitted);
  return ddl_fast_two_sum(exact.high, exact.low + (low_sum + lower_sum));
}

/* sum_n weights_n (x_n + f_n) of a coordinate in the same way; the order does not depend on the vector length. */
static inline dd weighted_total(const lanes *weights, const lanes *low, const lanes *lowest, const ddl (*x)[M],
    lanes (*f)[M], int i, double anchor)
{
  lanes part[GROUPS], omitted[GROUPS], rest[GROUPS];
  for (int n = 0; n < GROUPS; n++) {
    const ddl product = ddl_two_product(weights[n], x[n][i].high);
    part[n] = (anchor + product.high) - anchor;
    omitted[n] = product.high - part[n];
    rest[n] = multiply_add(low[n], x[n][i].high, lowest[n] * x[n][i].high) + product.low;
    rest[n] = multiply_add(weights[n], x[n][i].low + f[n][i], rest[n]);
  }
  const dd exact = dd_two_sum(points_total(part), points_total(omitted));
  return dd_fast_two_sum(exact.high, exact.low + points_total(rest));
}

static inline void begin_pairs(pair_step *w, const step_data *step, double t_low, double h_low)
{
  const dd h = dd_of(step->h, h_low), square = dd_square(h);
  w->t = dd_of(step->t, t_low);
  w->h = h;
  w->parameters = step->parameters;
  memcpy(w->X, step->points, sizeof w->X);
  mass_pairs(NULL, w->t, step->parameters, w->unit);
  for (int i = 0; i < M; i++) {
    const dd inverse_mass = dd_inverse(w->unit[i]), p = dd_of(step->p0[i], step->carry_p[i]);
    w->drift[i] = dd_multiply(dd_multiply(p, inverse_mass), h);
    w->unit[i] = dd_multiply(square, inverse_mass);
  }
}

static inline ddl time_of_points(const pair_step *w, int n)
{
  const ddl part = {ABSCISSA[n], ABSCISSA_LOW[n]};
  return ddl_add(ddl_of(w->t), ddl_multiply(part, ddl_of(w->h)));
}

/* Forces in pairs, derivatives of the forces, and sizes |q| + |h v| + h^2 |F| / m of the coordinates in the step. */
static inline void evaluate_pairs(pair_step *w, const double *q)
{
  for (int n = 0; n < GROUPS; n++) {
    const ddl t = time_of_points(w, n);
    ddl X[M];
    for (int i = 0; i < M; i++)
      X[i] = ddl_word(w->X[n][i]);
    force_lanes_pairs(X, t, w->parameters, w->F[n]);
    point_derivatives(w->X[n], t.high, w->parameters, w->vector[n] + M);
  }
  for (int i = 0; i < M; i++) {
    const double largest = largest_at_points(w->F, i);
    w->anchor[i] = ANCHOR * largest;
    w->inverse_size[i] = fabs(q[i]) + fabs(w->drift[i].high) + fabs(w->unit[i].high) * largest;
  }
  const double largest = largest_number(w->inverse_size);
  for (int i = 0; i < M; i++)
    w->inverse_size[i] = 1.0 / (w->inverse_size[i] + 1e-3 * largest + SMALLEST_SIZE);
}

/* Residual of the stage equations, as one word; the difference of X from the high word is exact. */
static inline void find_residual(pair_step *w, const double *q, const double *q_low)
{
  for (int i = 0; i < M; i++)
    for (int n = 0; n < GROUPS; n++) {
      const ddl sum = sum_of_pairs(PRODUCT, PRODUCT_LOW, PRODUCT_LOWEST, n, w->F, i, w->anchor[i]);
      const ddl moved = ddl_product(sum, ddl_of(w->unit[i])), drift = ddl_of(w->drift[i]);
      const ddl line = ddl_two_product(DRIFT[n], drift.high), start = ddl_two_sum(lanes_of(q[i]), line.high);
      const ddl point = ddl_two_sum(start.high, moved.high);
      const lanes lower = multiply_add(DRIFT_LOW[n], drift.high, DRIFT_LOWEST[n] * drift.high);
      const lanes low = line.low + multiply_add(DRIFT[n], drift.low, lower);
      w->rest[n][i] = (point.high - w->X[n][i]) + ((start.low + point.low) + ((low + q_low[i]) + moved.low));
    }
}

/* f = F_q D + e */
static inline void find_products(const pair_step *w, lanes (*e)[M], lanes (*f)[M])
{
  for (int n = 0; n < GROUPS; n++) {
    derivative_product(w->vector[n], lanes_of(w->t.high), w->parameters, f[n]);
    for (int i = 0; i < M; i++)
      f[n][i] += e[n][i];
  }
}

/* e = F(X + D) - F(X) - f of f = F_q D. */
static inline void find_bias(const pair_step *w, lanes (*f)[M], lanes (*e)[M])
{
  for (int n = 0; n < GROUPS; n++) {
    ddl X[M], F[M];
    for (int i = 0; i < M; i++)
      X[i] = ddl_two_sum(w->X[n][i], w->vector[n][i]);
    force_lanes_pairs(X, time_of_points(w, n), w->parameters, F);
    for (int i = 0; i < M; i++)
      e[n][i] = ((F[i].high - w->F[n][i].high) - f[n][i]) + (F[i].low - w->F[n][i].low);
  }
}

/* Solves for the correction D, which starts as the residual; f: F_q D + e. */
static inline int find_correction(pair_step *w, lanes (*f)[M])
{
  const double least = (SCALE * CORRECTED) * (SCALE * CORRECTED);
  double last = INFINITY, size; /* squares relative to the state: of the last change, of the residual */
  int curved = 0; /* whether e is known */
  coordinates e[GROUPS];
  lanes moved[GROUPS] = {{0.0}};
  memset(e, 0, sizeof e);
  for (int n = 0; n < GROUPS; n++)
    for (int i = 0; i < M; i++) {
      const lanes relative = w->rest[n][i] * (SCALE * w->inverse_size[i]);
      w->vector[n][i] = w->rest[n][i];
      moved[n] += relative * relative;
    }
  size = points_total(moved);
  find_products(w, e, f);
  for (int k = 0; k < MOST_CORRECTIONS; k++) {
    double change;
    memset(moved, 0, sizeof moved);
    for (int i = 0; i < M; i++)
      for (int n = 0; n < GROUPS; n++) {
        const lanes next = w->rest[n][i] + w->unit[i].high * apply(PRODUCT, n, f, i);
        const lanes relative = (next - w->vector[n][i]) * (SCALE * w->inverse_size[i]);
        moved[n] += relative * relative;
        w->vector[n][i] = next;
      }
    find_products(w, e, f);
    change = points_total(moved);
    if (!(change < INFINITY))
      return NOT_FINITE;
    if (change == 0.0 || (curved && (change <= least || (change < 0.25 * last && change * change <= least * last))))
      return OK;
    /* rounding errors of D, which stop the decrease; they matter in the 32nd digit of the state at most */
    if (curved && change > 0.25 * last &&
        change <= CORRECTED_ROUNDING * CORRECTED_ROUNDING * size * (change > 0.81 * last ? 100.0 : 1.0))
      return OK;
    if (!curved && change <= CURVED * CURVED * size) {
      find_bias(w, f, e);
      curved = 1;
    }
    last = change;
  }
  return NOT_CONVERGED;
}

/* Replaces the increments of a step, solved in double, by those in two words. On failure they are undefined. */
HOT int refine_increments(const step_data *step, double *memory, double t_low, double h_low, double *dq, double *dp,
    double *passed, double *workspace)
{
  pair_step w;
  coordinates f[GROUPS];
  int status;
  (void)memory, (void)passed, (void)workspace;
  begin_pairs(&w, step, t_low, h_low);
  evaluate_pairs(&w, step->q0);
  find_residual(&w, step->q0, step->carry_q);
  status = find_correction(&w, f);
  if (status != OK)
    return status;
  for (int i = 0; i < M; i++) {
    const dd bend = weighted_total(
        POINT_END_POSITION, POINT_END_POSITION_LOW, POINT_END_POSITION_LOWEST, w.F, f, i, w.anchor[i]);
    const dd push = weighted_total(
        POINT_END_MOMENTUM, POINT_END_MOMENTUM_LOW, POINT_END_MOMENTUM_LOWEST, w.F, f, i, w.anchor[i]);
    const dd q = dd_add(w.drift[i], dd_multiply(bend, w.unit[i])), p = dd_multiply(push, w.h);
    dq[i] = q.high, dq[M + i] = q.low, dp[i] = p.high, dp[M + i] = p.low;
  }
  return all_finite(dq, 2 * M) && all_finite(dp, 2 * M) ? OK : NOT_FINITE;
}
