/* Lanes are points: one vector, or several where a register holds fewer, are what differs from point to point of a
 * step, and numbers are those of one trajectory. Before it: vectors.h. The same names are in trajectories.h, for sweeps
 * that serve both. */
enum { GROUPS = POINTS / LANES }; /* vectors for all points */

typedef lanes coordinates[M]; /* what all coordinates have at a point */

typedef double number; /* what a trajectory has once */
typedef lanes weight; /* what each point has, for all trajectories */

static inline number number_of(double x)
{
  return x;
}

static inline lanes lanes_of_number(number x)
{
  return lanes_of(x);
}

static inline number magnitude(number x)
{
  return fabs(x);
}

static inline number exponential(number x)
{
  return exp(x);
}

static inline number exponential_less_1(number x)
{
  return expm1(x);
}

/* The largest of M numbers: of many in as many parts as a vector has, which do not wait for each other. */
static inline number largest_number(const number *x)
{
  const int whole = M > LANES ? M - M % LANES : 1;
  number largest = x[0];
  if (whole > 1) {
    lane_view parts;
    memcpy(&parts, x, sizeof parts);
    for (int i = LANES; i < whole; i += LANES)
      for (int j = 0; j < LANES; j++)
        parts.lane[j] = larger(parts.lane[j], x[i + j]);
    for (int j = 0; j < LANES; j++)
      largest = larger(largest, parts.lane[j]);
  }
  for (int i = whole; i < M; i++)
    largest = larger(largest, x[i]);
  return largest;
}

static inline number fused_numbers(number a, number b, number c)
{
  return fma(a, b, c);
}

static inline weight fused_weights(double a, weight b, weight c)
{
  return multiply_add(lanes_of(a), b, c);
}

/* What x is at a point; it stands `apart` from group to group. */
static inline double at_point(const lanes *x, long long apart, int j)
{
  return ((const lane_view *)(x + j / LANES * apart))->lane[j % LANES];
}

/* What point j gives to those of a group: column j of the table times x at j; x stands `apart` from group to group. */
static inline lanes given_by(const lanes *table, int group, const lanes *x, long long apart, int j)
{
  return table[j * GROUPS + group] * at_point(x, apart, j);
}

/* The sum of that over all points. From eight points on in four sums that do not wait for each other. */
static inline lanes given_by_all(const lanes *table, int group, const lanes *x, long long apart)
{
#if POINTS >= 8
  lanes a = given_by(table, group, x, apart, 0), b = given_by(table, group, x, apart, 1);
  lanes c = given_by(table, group, x, apart, 2), d = given_by(table, group, x, apart, 3);
  for (int j = 4; j < POINTS; j += 4) {
    a += given_by(table, group, x, apart, j);
    b += given_by(table, group, x, apart, j + 1);
    c += given_by(table, group, x, apart, j + 2);
    d += given_by(table, group, x, apart, j + 3);
  }
  return (a + b) + (c + d);
#else
  lanes a = given_by(table, group, x, apart, 0);
  for (int j = 1; j < POINTS; j++)
    a += given_by(table, group, x, apart, j);
  return a;
#endif
}

/* sum_j table_nj x_j of one coordinate, for the points of a group. */
static inline lanes apply(const lanes *table, int group, lanes (*x)[M], int i)
{
  return given_by_all(table, group, &x[0][i], M);
}

/* The same for all points in one vector. */
static inline lanes lanes_apply(const lanes *table, const lanes *x)
{
  return given_by_all(table, 0, x, 1);
}

static inline double lanes_total(lanes x)
{
  lane_view view = {x};
  for (int half = LANES / 2; half > 0; half /= 2)
    for (int j = 0; j < half; j++)
      view.lane[j] += view.lane[j + half];
  return view.lane[0];
}

/* The sum over the points of all groups, in the same order however many are in a vector. */
static inline double points_total(lanes *x)
{
  for (int half = GROUPS / 2; half > 0; half /= 2)
    for (int n = 0; n < half; n++)
      x[n] += x[n + half];
  return lanes_total(x[0]);
}

/* sum_n weights_n x_n of groups that stand `apart`; then with the low parts of the weights. */
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
    part[n] = multiply_add(weights[n], x[n * apart], low[n] * x[n * apart]);
  return points_total(part);
}

/* The same of one coordinate. */
static inline number weigh(const weight *weights, lanes (*x)[M], int i)
{
  return weigh_apart(weights, &x[0][i], M);
}

static inline number weigh_twice(const weight *weights, const weight *low, lanes (*x)[M], int i)
{
  return weigh_apart_twice(weights, low, &x[0][i], M);
}

/* What x is at the first point, and at the last. */
static inline number at_start(lanes (*x)[M], int i)
{
  return at_point(&x[0][i], M, 0);
}

static inline number at_end(lanes (*x)[M], int i)
{
  return at_point(&x[0][i], M, POINTS - 1);
}

/* What becomes of a change of each point: that of the trajectory. */
static inline number total_change(lanes change)
{
  return lanes_total(change);
}
