/* Sums over points for points.h and trajectories.h. Requires: LANES_OF_WEIGHT(x), the weight of a point in all
 * lanes. */

/* sum_n weights_n x_n of groups that are `apart` apart; weigh_apart_twice: with the low words of the weights. */
static inline number weigh_apart(const weight *weights, const lanes *x, long long apart)
{
  lanes part[GROUPS];
  for (int n = 0; n < GROUPS; n++)
    part[n] = weights[n] * x[n * apart];
  return points_total(part);
}

static inline number weigh_apart_twice(const weight *weights, const weight *low, const lanes *x, long long apart)
{
  lanes part[GROUPS];
  for (int n = 0; n < GROUPS; n++)
    part[n] = multiply_add(LANES_OF_WEIGHT(weights[n]), x[n * apart], low[n] * x[n * apart]);
  return points_total(part);
}

/* The same with further weights of the changes from values y. */
static inline number weigh_apart_thrice(const weight *weights, const weight *low, const lanes *x, const lanes *further,
    const lanes *y, long long apart)
{
  lanes part[GROUPS];
  for (int n = 0; n < GROUPS; n++) {
    const lanes rest = multiply_add(further[n], x[n * apart] - y[n * apart], low[n] * x[n * apart]);
    part[n] = multiply_add(LANES_OF_WEIGHT(weights[n]), x[n * apart], rest);
  }
  return points_total(part);
}

/* weigh_apart, and contribution_of_points, of one coordinate. */
static inline number weigh(const weight *weights, lanes (*x)[M], int i)
{
  return weigh_apart(weights, &x[0][i], M);
}

static inline lanes apply(const point_table table, int group, lanes (*x)[M], int i)
{
  return contribution_of_points(table, group, &x[0][i], M);
}
