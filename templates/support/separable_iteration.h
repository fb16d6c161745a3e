/* Fixed-point iteration of a step for constant diagonal masses and forces F(q, t) (Li, Wu & Leok, eqs. (25)-(30)): X_n
 * = q0 + h c_n v0 + h^2 sum_j (a A)_nj F(X_j) / m, with the quadrature points or the trajectories as SIMD lanes.
 * Coefficients are double-double: the sum of a table and its _LOW partner. Requires: points.h or trajectories.h with
 * what they require, the tables, the kernels force_lanes and mass. */

/* Constants of a step size: h^2 = square + square_low, h w = kick + kick_low. */
typedef struct {
  weight kick[GROUPS], kick_low[GROUPS];
  number inverse_mass[M];
  double square, square_low;
} iteration_data;

static void prepare_iteration(const step_data *step, iteration_data *data)
{
  const double h = step->h;
  data->square = h * h;
  data->square_low = fma(h, h, -data->square);
  for (int n = 0; n < GROUPS; n++) {
    data->kick[n] = h * POINT_END_MOMENTUM[n];
    data->kick_low[n] = fused_weights(h, POINT_END_MOMENTUM[n], -data->kick[n]) + h * POINT_END_MOMENTUM_LOW[n];
  }
  mass(NULL, step->t, step->parameters, data->inverse_mass);
  for (int i = 0; i < M; i++)
    data->inverse_mass[i] = 1.0 / data->inverse_mass[i];
}

#define FEW 8 /* coordinates, whose squared changes are added, which is faster */

/* Square of the largest change. For many coordinates the sum of the rounding errors would stay above the tolerance. A
 * NaN is detected later, by the increments. */
static inline lanes with_change(lanes change, lanes moved)
{
  return M <= FEW ? change + moved * moved : larger_lanes(change, moved * moved);
}

static inline void forces(const step_data *step, lanes (*X)[M], lanes (*F)[M])
{
  for (int n = 0; n < GROUPS; n++)
    force_lanes(X[n], step->t + step->h * ABSCISSA[n], step->parameters, F[n]);
}

/* x + (y + rest), where rest is below the rounding error of x + y, by a two-sum. */
static inline lanes sum_of_three(lanes x, lanes y, lanes rest)
{
  const lanes sum = x + y, part = sum - x;
  return sum + (((x - (sum - part)) + (y - part)) + rest);
}

/* Computes the increments of one step and their low words. The points X are iterated until they converge, then once
 * more with double-double coefficients; the forces are stored for the predictor. Rounding of the coefficients would
 * displace the points to the same side in every step, and the last iteration alone would leave a part of that, so that
 * all iterations include the low words, with the first forces. On failure the increments are undefined. */
HOT int fixed_point(const step_data *step, const iteration_data *data, history past, long long *steps, number *dq,
    number *dp,
    const solver_options *options, solver_report *report)
{
  coordinates X[GROUPS], base[GROUPS], rests[GROUPS], own[GROUPS], *F = kept(past, own);
  number drift[M], drift_low[M], inverse_size[M];
  progress now = before_iterations();
  int status;
  for (int i = 0; i < M; i++) {
    const number v = data->inverse_mass[i] * step->p0[i];
    const number v_low = fused_numbers(data->inverse_mass[i], step->p0[i], -v);
    drift[i] = step->h * v;
    drift_low[i] = fused_numbers(number_of(step->h), v, -drift[i]) +
        step->h * (v_low + data->inverse_mass[i] * step->carry_p[i]);
    for (int n = 0; n < GROUPS; n++)
      X[n][i] = base[n][i] = step->q0[i] + DRIFT[n] * drift[i];
  }
  if (*steps > 0) {
    continue_curve(step, past, *steps, F);
    for (int i = 0; i < M; i++)
      for (int n = 0; n < GROUPS; n++)
        X[n][i] += (data->square * data->inverse_mass[i]) * F[n][i];
  }
  forces(step, X, F);
  for (int i = 0; i < M; i++)
    inverse_size[i] = magnitude(step->q0[i]) + magnitude(drift[i]) +
        magnitude(data->square * data->inverse_mass[i] * at_start(F, i));
  invert_sizes(options, 1.0, inverse_size);
  for (int i = 0; i < M; i++)
    for (int n = 0; n < GROUPS; n++)
      rests[n][i] = step->carry_q[i] + DRIFT[n] * drift_low[i] + DRIFT_LOW[n] * drift[i] +
          data->inverse_mass[i] * (data->square * apply(PRODUCT_LOW, n, F, i));
  for (int k = 0; needs_iteration(&now); k++) {
    lanes change = lanes_of(0.0);
    for (int i = 0; i < M; i++)
      for (int n = 0; n < GROUPS; n++) {
        const lanes x = base[n][i] + ((data->square * data->inverse_mass[i]) * apply(PRODUCT, n, F, i) + rests[n][i]);
        const lanes moved = (x - X[n][i]) * inverse_size[i];
        change = with_change(change, moved);
        X[n][i] = x;
      }
    forces(step, X, F);
    take_change(&now, total_change(change), options, k, report);
  }
  status = outcome(&now, report);
  if (status != OK)
    return status;
  for (int i = 0; i < M; i++)
    for (int n = 0; n < GROUPS; n++) {
      const lanes sum = apply(PRODUCT, n, F, i), low = apply(PRODUCT_LOW, n, F, i);
      const lanes rest = step->carry_q[i] + DRIFT[n] * drift_low[i] + DRIFT_LOW[n] * drift[i];
      X[n][i] = sum_of_three(lanes_of_number(step->q0[i]),
          DRIFT[n] * drift[i] + data->inverse_mass[i] * (data->square * sum),
          rest + data->inverse_mass[i] * (data->square * low + data->square_low * sum));
    }
  forces(step, X, F);
  for (int i = 0; i < M; i++) {
    const number sum = weigh_twice(POINT_END_POSITION, POINT_END_POSITION_LOW, F, i);
    const number kick = data->inverse_mass[i] * (data->square * sum), part = (drift[i] + kick) - drift[i];
    dq[i] = drift[i] + kick;
    dq[M + i] = (drift[i] - (dq[i] - part)) + (kick - part) +
        (drift_low[i] + data->inverse_mass[i] * (data->square_low * sum));
    dp[i] = weigh_twice(data->kick, data->kick_low, F, i);
  }
  if (!accept(step, dq, dp, report))
    return NOT_FINITE;
  remember_curve(F, past);
  *steps = next_guess(*steps, &now, report);
  return OK;
}
