#include "../iteration/separable_iteration.h"

/* Step in double-double arithmetic by mixed precision. separable_iteration.h solves the stage equations in double, to
 * 1e-16; their residual in pairs, r = q0 + h c v0 + h^2 A F(X) / m - X, has 16 digits as one word, so that the
 * correction D = r + h^2 A (F_q D + e) / m, solved in double by fixed-point iteration, makes X accurate to 32 digits,
 * and so the forces F(X) + F_q D + e. As soon as D has two digits, a second evaluation of the forces in pairs gives e =
 * F(X + D) - F(X) - F_q D, what is quadratic in D: a bias of 1e-32, from which the energy would drift. Rounded tables
 * in double have a bias in D of 1e-16 of its own, so that the iteration in double has their low words, too. SIMD lanes
 * are the points of a trajectory, or trajectories, of which each has the bits that it has alone. Requires: the kernels
 * force_lanes_pairs, mass_pairs, point_derivatives and derivative_product; ANCHOR. */

#define CORRECTED 2e-33 /* last change of D, relative to the state */
#define CORRECTED_ROUNDING 1e-15 /* changes relative to the residual that may be rounding errors; ten times these are */
#define CURVED 1e-2 /* changes relative to the residual at which e is computed */
#define SCALE 1e15 /* of changes, whose squares are normal numbers then */
#define SMALLEST_SIZE 1e-280 /* of a coordinate; 1e15 times its inverse is finite */
#define MOST_CORRECTIONS 200

/* Pairs of a value of the trajectory or of each one, a number, and of a value of the points or of one, a weight. */
#ifdef POINTS
typedef dd number_pair;
typedef ddl weight_pair;
#define OF_NUMBERS(name) dd_##name
#define OF_WEIGHTS(name) ddl_##name
#define NUMBER_PAIR(high, low) dd_of(high, low)
#define WEIGHT_PAIR(x) ddl_of(x)
#define WEIGHT_OF(x) lanes_of(x)
#define CHOSEN(wanted, x, y) (x) /* y for trajectories where `wanted` is 0 */
#define SUM_OF_POINTS(x) points_total(x)
#define AT_POINT(x, i, j, word) lanes_of(lane_of(&(x)[(j) / LANES][i].word, (j) % LANES))
#else
typedef ddl number_pair;
typedef dd weight_pair;
#define OF_NUMBERS(name) ddl_##name
#define OF_WEIGHTS(name) dd_##name
#define NUMBER_PAIR(high, low) ddl_of_words(high, low)
#define WEIGHT_PAIR(x) (x)
#define WEIGHT_OF(x) (x)
#define CHOSEN(wanted, x, y) lanes_selected(wanted, x, y)
#define SUM_OF_POINTS(x) sum_of_points(x)
#define AT_POINT(x, i, j, word) (x)[j][i].word
#define COLUMNS S
#endif

enum { TRAJECTORIES = sizeof(number) / sizeof(double) };

typedef union {
  number all;
  double of[TRAJECTORIES];
} number_view;

/* Arguments of a step, and its points. */
typedef struct {
  dd t, h;
  number_pair drift[M], unit[M]; /* h v; h^2 / m */
  number inverse_size[M], anchor[M];
  const number *parameters;
  coordinates X[GROUPS], rest[GROUPS];
  ddl F[GROUPS][M];
  lanes vector[GROUPS][M + POINT_DERIVATIVES]; /* D, then the derivatives */
} pair_step;

static inline number_pair numbers_of_pair(dd x)
{
  return NUMBER_PAIR(number_of(x.high), number_of(x.low));
}

static inline ddl lanes_of_pair(number_pair x)
{
  return ddl_of_words(lanes_of_number(x.high), lanes_of_number(x.low));
}

/* sum_j table_gj x_j of a coordinate, with the rest of x_j. The sum begins with a large number, the anchor, so that all
 * partial sums have the same unit and are exact, and so is the sum of what they omit of the products (Rump, Ogita &
 * Oishi 2008). Tables have three words: those of two are of another method, which is not symplectic, so that the energy
 * would drift by 3e-35 a step, more in a million steps than the random walk of rounding errors. The third word is added
 * to a product: in a sum it would be less than half a unit of the others. */
static inline __attribute__((always_inline)) ddl sum_with_rest(const point_table table, const point_table low,
    const point_table lowest, int g, const ddl (*x)[M], lanes (*f)[M], int i, number anchor)
{
  lanes sum = lanes_of_number(anchor), omitted = lanes_of(0.0), low_sum = omitted, lower_sum = omitted;
#pragma GCC unroll 32
  for (int j = 0; j < COLUMNS; j++) {
    const lanes a = LANES_OF_WEIGHT(TABLE_ENTRY(table, g, j)), high = AT_POINT(x, i, j, high);
    const lanes rest = f ? AT_POINT(x, i, j, low) + f[j][i] : AT_POINT(x, i, j, low);
    const ddl product = ddl_two_product(a, high);
    const lanes next = sum + product.high;
    omitted += product.high - (next - sum);
    low_sum += product.low;
    lower_sum += multiply_add(a, rest,
        multiply_add(LANES_OF_WEIGHT(TABLE_ENTRY(low, g, j)), high, TABLE_ENTRY(lowest, g, j) * high));
    sum = next;
  }
  const ddl exact = ddl_two_sum(sum - anchor, omitted);
  return ddl_fast_two_sum(exact.high, exact.low + (low_sum + lower_sum));
}

static inline ddl sum_of_pairs(const point_table table, const point_table low, const point_table lowest, int g,
    const ddl (*x)[M], int i, number anchor)
{
  return sum_with_rest(table, low, lowest, g, x, NULL, i, anchor);
}

#ifdef POINTS
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
#else
static inline number largest_at_points(const ddl (*x)[M], int i)
{
  number largest = magnitude(x[0][i].high);
  for (int n = 1; n < S; n++)
    largest = larger_lanes(largest, magnitude(x[n][i].high));
  return largest;
}

static inline number sum_of_points(const lanes *x)
{
  number sum = x[0];
  for (int n = 1; n < S; n++)
    sum += x[n];
  return sum;
}

#define weighted_total(weights, low, lowest, x, f, i, anchor) \
  sum_with_rest(&(weights), &(low), &(lowest), 0, x, f, i, anchor)
#endif

static inline void begin_pairs(pair_step *w, const step_data *step, double t_low, double h_low)
{
  const dd h = dd_of(step->h, h_low), square = dd_square(h);
  w->t = dd_of(step->t, t_low);
  w->h = h;
  w->parameters = step->parameters;
  memcpy(w->X, step->points, sizeof w->X);
  mass_pairs(NULL, w->t, step->parameters, w->unit);
  for (int i = 0; i < M; i++) {
    const number_pair inverse_mass = OF_NUMBERS(inverse)(w->unit[i]), p = NUMBER_PAIR(step->p0[i], step->carry_p[i]);
    w->drift[i] = OF_NUMBERS(multiply)(OF_NUMBERS(multiply)(p, inverse_mass), numbers_of_pair(h));
    w->unit[i] = OF_NUMBERS(multiply)(numbers_of_pair(square), inverse_mass);
  }
}

static inline weight_pair time_of_points(const pair_step *w, int n)
{
  const weight_pair part = {ABSCISSA[n], ABSCISSA_LOW[n]};
  return OF_WEIGHTS(add)(WEIGHT_PAIR(w->t), OF_WEIGHTS(multiply)(part, WEIGHT_PAIR(w->h)));
}

/* Forces in pairs, derivatives of the forces, and sizes |q| + |h v| + h^2 |F| / m of the coordinates in the step. */
static inline void evaluate_pairs(pair_step *w, const number *q)
{
  for (int n = 0; n < GROUPS; n++) {
    const weight_pair t = time_of_points(w, n);
    ddl X[M];
    for (int i = 0; i < M; i++)
      X[i] = ddl_word(w->X[n][i]);
    force_lanes_pairs(X, t, w->parameters, w->F[n]);
    point_derivatives(w->X[n], t.high, w->parameters, w->vector[n] + M);
  }
  for (int i = 0; i < M; i++) {
    const number largest = largest_at_points(w->F, i);
    w->anchor[i] = ANCHOR * largest;
    w->inverse_size[i] = magnitude(q[i]) + magnitude(w->drift[i].high) + magnitude(w->unit[i].high) * largest;
  }
  const number largest = largest_number(w->inverse_size);
  for (int i = 0; i < M; i++)
    w->inverse_size[i] = 1.0 / (w->inverse_size[i] + 1e-3 * largest + SMALLEST_SIZE);
}

/* Residual of the stage equations, as one word; the difference of X from the high word is exact. */
static inline void find_residual(pair_step *w, const number *q, const number *q_low)
{
  for (int i = 0; i < M; i++)
    for (int n = 0; n < GROUPS; n++) {
      const ddl sum = sum_of_pairs(PRODUCT, PRODUCT_LOW, PRODUCT_LOWEST, n, w->F, i, w->anchor[i]);
      const ddl moved = ddl_product(sum, lanes_of_pair(w->unit[i])), drift = lanes_of_pair(w->drift[i]);
      const lanes node = LANES_OF_WEIGHT(DRIFT[n]);
      const ddl line = ddl_two_product(node, drift.high), start = ddl_two_sum(lanes_of_number(q[i]), line.high);
      const ddl point = ddl_two_sum(start.high, moved.high);
      const lanes lower = multiply_add(LANES_OF_WEIGHT(DRIFT_LOW[n]), drift.high, DRIFT_LOWEST[n] * drift.high);
      const lanes low = line.low + multiply_add(node, drift.low, lower);
      w->rest[n][i] = (point.high - w->X[n][i]) + ((start.low + point.low) + ((low + q_low[i]) + moved.low));
    }
}

/* f = F_q D + e */
static inline void find_products(const pair_step *w, lanes (*e)[M], lanes (*f)[M])
{
  for (int n = 0; n < GROUPS; n++) {
    derivative_product(w->vector[n], WEIGHT_OF(w->t.high), w->parameters, f[n]);
    for (int i = 0; i < M; i++)
      f[n][i] += e[n][i];
  }
}

/* e = F(X + D) - F(X) - f of f = F_q D, where it is wanted. */
static inline void find_bias(const pair_step *w, number wanted, lanes (*f)[M], lanes (*e)[M])
{
  for (int n = 0; n < GROUPS; n++) {
    ddl X[M], F[M];
    for (int i = 0; i < M; i++)
      X[i] = ddl_two_sum(w->X[n][i], w->vector[n][i]);
    force_lanes_pairs(X, time_of_points(w, n), w->parameters, F);
    for (int i = 0; i < M; i++) {
      const lanes bias = ((F[i].high - w->F[n][i].high) - f[n][i]) + (F[i].low - w->F[n][i].low);
      e[n][i] = CHOSEN(wanted, bias, e[n][i]);
    }
  }
}

/* States of the correction of a trajectory: e is 0, is to be computed, is known; D is found, is not. */
enum { LINEAR,
  CURVING,
  QUADRATIC,
  SOLVED,
  SLOW,
  INFINITE };

/* State after the k-th change; squares of the changes and of the residual, relative to the state. */
static inline int next_state(int state, double change, double last, double size, int k)
{
  const double least = (SCALE * CORRECTED) * (SCALE * CORRECTED);
  const int curved = state == QUADRATIC;
  if (!(change < INFINITY))
    return INFINITE;
  if (change == 0.0 || (curved && (change <= least || (change < 0.25 * last && change * change <= least * last))))
    return SOLVED;
  /* rounding errors of D, which stop the decrease; they matter in the 32nd digit of the state at most */
  if (curved && change > 0.25 * last &&
      change <= CORRECTED_ROUNDING * CORRECTED_ROUNDING * size * (change > 0.81 * last ? 100.0 : 1.0))
    return SOLVED;
  if (k == MOST_CORRECTIONS)
    return SLOW;
  return !curved && change <= CURVED * CURVED * size ? CURVING : state;
}

/* Solves for the correction D, which starts as the residual; f: F_q D + e. Of each trajectory with the state LINEAR,
 * which waits for the others before e is computed; afterwards, it has one of the last three states. */
static inline void find_correction(pair_step *w, lanes (*f)[M], int *state)
{
  number_view last = {number_of(INFINITY)}, size, wanted; /* squares relative to the state; iterating trajectories */
  int count[TRAJECTORIES] = {0}, open = 0;
  coordinates e[GROUPS];
  lanes moved[GROUPS] = {{0.0}};
  memset(e, 0, sizeof e);
  for (int n = 0; n < GROUPS; n++)
    for (int i = 0; i < M; i++) {
      const lanes relative = w->rest[n][i] * (SCALE * w->inverse_size[i]);
      w->vector[n][i] = w->rest[n][i];
      moved[n] += relative * relative;
    }
  size.all = SUM_OF_POINTS(moved);
  for (int j = 0; j < TRAJECTORIES; j++) {
    wanted.of[j] = state[j] == LINEAR;
    open |= state[j] == LINEAR;
  }
  find_products(w, e, f);
  while (open) {
    int linear = 0, curving = 0;
    memset(moved, 0, sizeof moved);
    for (int i = 0; i < M; i++)
      for (int n = 0; n < GROUPS; n++) {
        const lanes next = w->rest[n][i] + w->unit[i].high * apply(PRODUCT, n, f, i);
        const lanes relative = (next - w->vector[n][i]) * (SCALE * w->inverse_size[i]);
        moved[n] += relative * relative;
        w->vector[n][i] = CHOSEN(wanted.all, next, w->vector[n][i]);
      }
    find_products(w, e, f);
    const number_view change = {SUM_OF_POINTS(moved)};
    open = 0;
    for (int j = 0; j < TRAJECTORIES; j++) {
      if (wanted.of[j] > 0.0) {
        state[j] = next_state(state[j], change.of[j], last.of[j], size.of[j], ++count[j]);
        last.of[j] = change.of[j];
      }
      linear |= state[j] == LINEAR;
      curving |= state[j] == CURVING;
      wanted.of[j] = state[j] == LINEAR || state[j] == QUADRATIC;
      open |= wanted.of[j] > 0.0;
    }
    if (curving && !linear) {
      for (int j = 0; j < TRAJECTORIES; j++) {
        wanted.of[j] = state[j] == CURVING;
        state[j] = state[j] == CURVING ? QUADRATIC : state[j];
      }
      find_bias(w, wanted.all, f, e);
      open = 1;
    }
  }
}

/* Replaces the increments of a step, solved in double, by those in two words, where the state is LINEAR. */
HOT void refine_step(const step_data *step, double t_low, double h_low, number *dq, number *dp, int *state)
{
  pair_step w;
  coordinates f[GROUPS];
  int solved = 0;
  begin_pairs(&w, step, t_low, h_low);
  evaluate_pairs(&w, step->q0);
  find_residual(&w, step->q0, step->carry_q);
  find_correction(&w, f, state);
  for (int j = 0; j < TRAJECTORIES; j++)
    solved |= state[j] == SOLVED;
  if (!solved)
    return;
  for (int i = 0; i < M; i++) {
    const number_pair bend = weighted_total(
        POINT_END_POSITION, POINT_END_POSITION_LOW, POINT_END_POSITION_LOWEST, w.F, f, i, w.anchor[i]);
    const number_pair push = weighted_total(
        POINT_END_MOMENTUM, POINT_END_MOMENTUM_LOW, POINT_END_MOMENTUM_LOWEST, w.F, f, i, w.anchor[i]);
    const number_pair q = OF_NUMBERS(add)(w.drift[i], OF_NUMBERS(multiply)(bend, w.unit[i]));
    const number_pair p = OF_NUMBERS(multiply)(push, numbers_of_pair(w.h));
    dq[i] = q.high, dq[M + i] = q.low, dp[i] = p.high, dp[M + i] = p.low;
  }
}

#ifdef POINTS
/* Replaces the increments of a step. On failure they are undefined. */
HOT int refine_increments(const step_data *step, double *memory, double t_low, double h_low, double *dq, double *dp,
    double *passed, double *workspace)
{
  int state = LINEAR;
  refine_step(step, t_low, h_low, dq, dp, &state);
  if (state != SOLVED)
    return state == SLOW ? NOT_CONVERGED : NOT_FINITE;
  return all_finite(dq, 2 * M) && all_finite(dp, 2 * M) ? OK : NOT_FINITE;
}
#else
/* Replaces the increments of active trajectories; those that fail become inactive. */
static void refine_increments(const step_data *step, double *active, lanes *dq, lanes *dp)
{
  int state[LANES];
  for (int j = 0; j < LANES; j++)
    state[j] = active[j] > 0.0 ? LINEAR : SLOW;
  refine_step(step, step->t_low, step->h_low, dq, dp, state);
  for (int j = 0; j < LANES; j++)
    active[j] = state[j] == SOLVED ? active[j] : 0.0;
}
#endif
