/* Growth of tangent vectors, which are coordinates after those of their trajectory (the series are those of
 * scvi_codegen/extras/chaos/indicators.py). Requires: trajectories.h, the type state, and TANGENTS, the number of
 * vectors. */
enum { OWN = M / (TANGENTS + 1) }; /* coordinates of the trajectory */

/* Logarithms of norms, their maxima, and of the diagonal of R; integrals of MEGNO; R with columns of length 1. */
typedef struct {
  lanes norm[TANGENTS], largest[TANGENTS], diagonal[TANGENTS], moment[TANGENTS], rate[TANGENTS], area[TANGENTS];
  lanes triangle[TANGENTS][TANGENTS];
} tangent_growth;

LANE_BY_LANE(root_of, sqrt);
LANE_BY_LANE(logarithm_of, log);

/* 1 / length - 1, or 0 for a vector of length 0. */
static inline lanes normalising(lanes length)
{
  lane_view view = {length};
  for (int j = 0; j < LANES; j++)
    view.lane[j] = view.lane[j] > 0.0 ? 1.0 / view.lane[j] - 1.0 : 0.0;
  return view.all;
}

/* Adds a multiple of one tangent vector to another, in the state and in the stored values of the last two steps, which
 * are linear in it. */
static inline void add_tangent(state *now, history past, int to, int from, lanes factor)
{
  for (int i = 0; i < OWN; i++) {
    const int a = (to + 1) * OWN + i, b = (from + 1) * OWN + i;
    now->q[a] += factor * now->q[b];
    now->p[a] += factor * now->p[b];
    for (int n = 0; n < S; n++) {
      past.last[n][a] += factor * past.last[n][b];
      past.before[n][a] += factor * past.before[n][b];
    }
  }
}

static inline lanes tangent_product(const state *now, int j, int k)
{
  lanes sum = lanes_of(0.0);
  for (int i = 0; i < OWN; i++) {
    const int a = (j + 1) * OWN + i, b = (k + 1) * OWN + i;
    sum += now->q[a] * now->q[b] + now->p[a] * now->p[b];
  }
  return sum;
}

/* Replaces tangent vectors by Q of their QR factorisation (modified Gram-Schmidt, repeated) and adds
 * the growth of a step of size |h| that ends `passed` after the start; integrals by the trapezoidal rule. */
static void add_growth(tangent_growth *all, state *now, history past, double passed, double h)
{
  lanes r[TANGENTS][TANGENTS];
  for (int i = OWN; i < M; i++)
    now->carry_q[i] = now->carry_p[i] = lanes_of(0.0);
  for (int j = 0; j < TANGENTS; j++) {
    for (int k = 0; k < j; k++)
      r[k][j] = lanes_of(0.0);
    for (int again = 0; again < (TANGENTS > 1 ? 2 : 1); again++)
      for (int k = 0; k < j; k++) {
        const lanes product = tangent_product(now, k, j);
        add_tangent(now, past, j, k, -product);
        r[k][j] += product;
      }
    r[j][j] = root_of(tangent_product(now, j, j));
    add_tangent(now, past, j, j, normalising(r[j][j]));
  }
  for (int j = 0; j < TANGENTS; j++) {
    lanes column[TANGENTS], size = lanes_of(0.0), change, rate;
    for (int i = 0; i < TANGENTS; i++) {
      column[i] = lanes_of(0.0);
      for (int k = i; k < TANGENTS; k++)
        column[i] += r[i][k] * all->triangle[k][j];
      size += column[i] * column[i];
    }
    size = root_of(size);
    for (int i = 0; i < TANGENTS; i++)
      all->triangle[i][j] = column[i] / size;
    change = logarithm_of(size);
    all->norm[j] += change;
    all->largest[j] = larger_lanes(all->largest[j], all->norm[j]);
    all->diagonal[j] += logarithm_of(r[j][j]);
    all->moment[j] += (passed - 0.5 * h) * change;
    rate = 2.0 * all->moment[j] / passed;
    all->area[j] += 0.5 * h * (rate + all->rate[j]);
    all->rate[j] = rate;
  }
}

/* Stores the five series of the tangent vectors of the first `count` trajectories, one row each. */
static inline void store_growth(const tangent_growth *all, double passed, int count, double *value)
{
  for (int i = 0; i < TANGENTS; i++) {
    const lane_view series[] = {
        {all->norm[i]}, {all->largest[i]}, {all->diagonal[i]}, {all->rate[i]}, {all->area[i] / passed}};
    for (int j = 0; j < count; j++)
      for (int k = 0; k < 5; k++)
        value[(j * 5 + k) * TANGENTS + i] = series[k].lane[j];
  }
}
