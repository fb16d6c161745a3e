/* Vectors over all points of all coordinates; every thread computes its own part. Requires: indexed_newton.h. */

/* Inner product of scaled vectors. */
static double inner_product(const linear_system *of, const lanes *x, const lanes *y)
{
  const double scale = of->by_size.scale;
  sums all;
  begin_sums(&all, of->run, of->n);
  while (next_block(&all)) {
    lanes a = lanes_of(0.0), b = lanes_of(0.0);
    for (int g = 0; g < GROUPS; g++) {
      long long i = g * of->n + all.here.first;
      const long long end = g * of->n + all.here.end;
      for (; i + 1 < end; i += 2) {
        a += (scale * x[i]) * (scale * y[i]);
        b += (scale * x[i + 1]) * (scale * y[i + 1]);
      }
      if (i < end)
        a += (scale * x[i]) * (scale * y[i]);
    }
    add_block(&all, lanes_total(a + b), 0.0);
  }
  wait_at_barrier(of->run);
  return sum_of(&all, 0);
}

/* y += by x, for the coordinates of this thread. */
static void add_multiple(const linear_system *of, lanes *restrict y, double by, const lanes *restrict x)
{
  for (int g = 0; g < GROUPS; g++)
    for (long long i = g * of->n + of->own.first; i < g * of->n + of->own.end; i++)
      y[i] += by * x[i];
}

/* x = by y, for the coordinates of this thread. */
static void scale(const linear_system *of, lanes *x, double by, const lanes *y)
{
  for (int g = 0; g < GROUPS; g++)
    for (long long i = g * of->n + of->own.first; i < g * of->n + of->own.end; i++)
      x[i] = by * y[i];
}

static void make_zero(const linear_system *of, lanes *x)
{
  for (int g = 0; g < GROUPS; g++)
    memset(x + g * of->n + of->own.first, 0, sizeof(lanes) * (size_t)(of->own.end - of->own.first));
}
