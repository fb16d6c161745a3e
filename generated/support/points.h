/* Lanes are points: one vector holds what differs from point to point of a step, and numbers are those of one
 * trajectory. Before it: vectors.h. The same names are in trajectories.h, for sweeps that serve both. */
enum { GROUPS = 1 }; /* vectors for all points */

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

/* sum_j table_j x_j for all points; column j of a table is what point j gives to all. From eight lanes on in four sums
 * that do not wait for each other. */
static inline lanes lanes_apply(const lanes *table, const lanes *vector)
{
  const lane_view *x = (const lane_view *)vector;
#if LANES >= 8
  lanes a = table[0] * x->lane[0], b = table[1] * x->lane[1], c = table[2] * x->lane[2], d = table[3] * x->lane[3];
  for (int j = 4; j < LANES; j += 4) {
    a += table[j] * x->lane[j];
    b += table[j + 1] * x->lane[j + 1];
    c += table[j + 2] * x->lane[j + 2];
    d += table[j + 3] * x->lane[j + 3];
  }
  return (a + b) + (c + d);
#else
  lanes a = table[0] * x->lane[0];
  for (int j = 1; j < LANES; j++)
    a += table[j] * x->lane[j];
  return a;
#endif
}

static inline lanes apply(const lanes *table, int group, lanes (*x)[M], int i)
{
  return lanes_apply(table, &x[group][i]);
}

static inline double lanes_total(lanes x)
{
  lane_view view = {x};
  for (int half = LANES / 2; half > 0; half /= 2)
    for (int j = 0; j < half; j++)
      view.lane[j] += view.lane[j + half];
  return view.lane[0];
}

/* sum_n weights_n x_n; then with the low parts of the weights. */
static inline number weigh(const weight *weights, lanes (*x)[M], int i)
{
  return lanes_total(weights[0] * x[0][i]);
}

static inline number weigh_twice(const weight *weights, const weight *low, lanes (*x)[M], int i)
{
  return lanes_total(multiply_add(weights[0], x[0][i], low[0] * x[0][i]));
}

/* What x is at the first point, and at the last. */
static inline number at_start(lanes (*x)[M], int i)
{
  const lane_view view = {x[0][i]};
  return view.lane[0];
}

static inline number at_end(lanes (*x)[M], int i)
{
  const lane_view view = {x[0][i]};
  return view.lane[LANES - 1];
}

/* What becomes of a change of each point: that of the trajectory. */
static inline number total_change(lanes change)
{
  return lanes_total(change);
}
