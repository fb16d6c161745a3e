/* Growth of tangent vectors, which are coordinates after those of their trajectory, along a thread of a GPU (the series
 * are those of scvi_codegen/runtime/chaos/indicators.py). Requires: thread_memory, TANGENTS, the number of vectors. */
enum { OWN = M / (TANGENTS + 1) }; /* coordinates of the trajectory */

/* Adds a multiple of one tangent vector to another, in the state and in the stored values, which are linear in it. */
static inline void add_tangent(thread_memory *own, int to, int from, double factor)
{
  for (int i = 0; i < OWN; i++) {
    const int a = (to + 1) * OWN + i, b = (from + 1) * OWN + i;
    own->now.q[a] += factor * own->now.q[b];
    own->now.p[a] += factor * own->now.p[b];
    for (int n = 0; n < S; n++) {
      own->last[n][a] += factor * own->last[n][b];
      own->before[n][a] += factor * own->before[n][b];
    }
  }
}

static inline double tangent_product(const state *now, int j, int k)
{
  double sum = 0.0;
  for (int i = 0; i < OWN; i++) {
    const int a = (j + 1) * OWN + i, b = (k + 1) * OWN + i;
    sum += now->q[a] * now->q[b] + now->p[a] * now->p[b];
  }
  return sum;
}

/* Replaces tangent vectors by Q of their QR factorisation (modified Gram-Schmidt, repeated) and adds
 * the growth of a step of size |h| that ends `passed` after the start; integrals by the trapezoidal rule. */
static void add_growth(thread_memory *own, double passed, double h)
{
  tangent_growth *all = &own->growth;
  double r[TANGENTS][TANGENTS] = {{0.0}};
  for (int i = OWN; i < M; i++)
    own->now.carry_q[i] = own->now.carry_p[i] = 0.0;
  for (int j = 0; j < TANGENTS; j++) {
    double length;
    for (int again = 0; again < (TANGENTS > 1 ? 2 : 1); again++)
      for (int k = 0; k < j; k++) {
        const double product = tangent_product(&own->now, k, j);
        add_tangent(own, j, k, -product);
        r[k][j] += product;
      }
    length = sqrt(tangent_product(&own->now, j, j));
    add_tangent(own, j, j, length > 0.0 ? 1.0 / length - 1.0 : 0.0);
    r[j][j] = length;
  }
  for (int j = 0; j < TANGENTS; j++) {
    double column[TANGENTS], size = 0.0, change, rate;
    for (int i = 0; i < TANGENTS; i++) {
      column[i] = 0.0;
      for (int k = i; k < TANGENTS; k++)
        column[i] += r[i][k] * all->triangle[k][j];
      size += column[i] * column[i];
    }
    size = sqrt(size);
    for (int i = 0; i < TANGENTS; i++)
      all->triangle[i][j] = column[i] / size;
    change = log(size);
    all->norm[j] += change;
    all->largest[j] = larger(all->largest[j], all->norm[j]);
    all->diagonal[j] += log(r[j][j]);
    all->moment[j] += (passed - 0.5 * h) * change;
    rate = 2.0 * all->moment[j] / passed;
    all->area[j] += 0.5 * h * (rate + all->rate[j]);
    all->rate[j] = rate;
  }
}

/* Stores the five series of the tangent vectors. */
static inline void store_growth(const tangent_growth *all, double passed, double *value)
{
  for (int j = 0; j < TANGENTS; j++) {
    value[j] = all->norm[j];
    value[TANGENTS + j] = all->largest[j];
    value[2 * TANGENTS + j] = all->diagonal[j];
    value[3 * TANGENTS + j] = all->rate[j];
    value[4 * TANGENTS + j] = all->area[j] / passed;
  }
}
