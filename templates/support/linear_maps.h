/* Changes of what a step starts from, of its unknowns, of what stands at points, of rows; the linear maps between
 * them, and their transposes. Before it: real, M, B, GIVEN, WIDTH, band.h, stages.h. */

/* WIDTH changes at a time. */
typedef struct {
  real lane[WIDTH];
} wide;

/* y += factor x, another; or back: x += factor y. */
static inline void flow(int back, wide *y, real factor, wide *x)
{
  real *restrict to = back ? x->lane : y->lane;
  const real *restrict from = back ? y->lane : x->lane;
  for (int j = 0; j < WIDTH; j++)
    to[j] += factor * from[j];
}

/* Sums between unknowns, or rows, and what stands at points from `offset` on: for so many sites from the first, times
 * h^power. */
typedef struct {
  const real *table;
  int first, sites, offset, power, from_state;
} linear_loop;

/* Slopes from the first on: of the result `to` places on by the argument `from` places on. */
typedef struct {
  const int (*pair)[2];
  int count, first, to, from;
} slope_block;

typedef void slope_kernel(const real *u, real t, const real *parameters, real *value, real *slope);
typedef void value_kernel(const real *u, real t, const real *parameters, real *value);

/* Points of one kind: how many there are of everything; where arguments come from, where results go; the kernel with
 * its slopes by the arguments, and, given ones, by parameters and time: {i, j}, j from the first parameter on; how all
 * of these change, where results are not linear and it is asked for. */
typedef struct {
  int points, arguments, results, slopes, given, gathers, scatters, blocks;
  const linear_loop *gather, *scatter;
  const slope_block *block;
  const real *weight, *abscissa;
  slope_kernel *kernel;
  value_kernel *by_given;
  const int (*given_pair)[2];
  value_kernel *curvature;
} point_family;

static real power_of(real h, int k)
{
  real product = 1;
  for (int i = 0; i < (k < 0 ? -k : k); i++)
    product *= h;
  return k < 0 ? 1 / product : product;
}

/* The arguments at each point. */
static void arguments_of(const point_family *f, const step_data *step, const real *z, real *at)
{
  for (int g = 0; g < f->gathers; g++) {
    const linear_loop *loop = f->gather + g;
    const real scale = power_of(step->h, loop->power);
    gather(loop->table, f->points, scale, z + loop->first * B, loop->sites, at + loop->offset, f->arguments, 1);
    if (loop->from_state)
      offset(step, f->points, at + loop->offset, f->arguments);
  }
}

static real time_of(const point_family *f, const step_data *step, int n)
{
  return step->t + (f->abscissa ? f->abscissa[n] * step->h : 0);
}

/* At each point: by h, unknowns held, the slopes of arguments and of what results are multiplied by; those of results
 * by arguments; those by parameters and time. Returns where they end. */
static real *slopes_of(const point_family *f, const step_data *step, const real *z, real *by_h)
{
  const real h = step->h;
  real *value = by_h + f->points * f->arguments, *slope = value + f->points * f->results;
  real *given = slope + f->points * f->slopes;
  arguments_of(f, step, z, by_h);
  for (int n = 0; n < f->points; n++) {
    const real t = time_of(f, step, n), *u = by_h + n * f->arguments;
    f->kernel(u, t, step->parameters, value + n * f->results, slope + n * f->slopes);
    if (f->given)
      f->by_given(u, t, step->parameters, given + n * f->given);
  }
  for (int g = 0; g < f->gathers; g++) {
    const linear_loop *loop = f->gather + g;
    const real scale = (real)loop->power * power_of(h, loop->power - 1);
    gather(loop->table, f->points, scale, z + loop->first * B, loop->sites, by_h + loop->offset, f->arguments, 1);
  }
  for (int s = 0; s < f->scatters; s++)
    for (int n = 0; n < f->points; n++)
      for (int i = 0; i < f->scatter[s].sites; i++)
        value[n * f->results + f->scatter[s].offset + i] *= (real)f->scatter[s].power / h;
  return given + f->points * f->given;
}

/* From unknowns to arguments. */
static void gather_wide(const point_family *f, real h, int back, wide *dz, wide *u)
{
  for (int g = 0; g < f->gathers; g++) {
    const linear_loop *loop = f->gather + g;
    const real scale = power_of(h, loop->power);
    for (int i = 0; i < loop->sites; i++)
      for (int b = 0; b < B; b++)
        for (int n = 0; n < f->points; n++)
          flow(back, u + n * f->arguments + loop->offset + i, scale * loop->table[b * f->points + n],
              dz + (loop->first + i) * B + b);
  }
}

/* From q0 and h to arguments. */
static void start_wide(const point_family *f, int back, const real *by_h, wide *v, wide *u)
{
  for (int g = 0; g < f->gathers; g++)
    for (int n = 0; f->gather[g].from_state && n < f->points; n++)
      for (int i = 0; i < M; i++)
        flow(back, u + n * f->arguments + f->gather[g].offset + i, 1, v + i);
  for (int i = 0; i < f->points * f->arguments; i++)
    flow(back, u + i, by_h[i], v + GIVEN_H);
}

/* From parameters, t and h to results. */
static void given_wide(const point_family *f, int back, const real *by_h, const real *given, wide *v, wide *value)
{
  for (int n = 0; n < f->points; n++)
    for (int e = 0; e < f->given; e++) {
      wide *result = value + n * f->results + f->given_pair[e][0], *from = v + 2 * M + f->given_pair[e][1];
      flow(back, result, given[n * f->given + e], from);
      if (from == v + GIVEN_H - 1)
        flow(back, result, given[n * f->given + e] * f->abscissa[n], v + GIVEN_H);
    }
  for (int i = 0; i < f->points * f->results; i++)
    flow(back, value + i, by_h[i], v + GIVEN_H);
}

/* From arguments to results. */
static void multiply_wide(const point_family *f, int back, const real *slope, wide *u, wide *value)
{
  for (int k = 0; k < f->blocks; k++)
    for (int n = 0; n < f->points; n++)
      for (int e = 0; e < f->block[k].count; e++)
        flow(back, value + n * f->results + f->block[k].to + f->block[k].pair[e][0],
            slope[n * f->slopes + f->block[k].first + e],
            u + n * f->arguments + f->block[k].from + f->block[k].pair[e][1]);
}

/* From results to rows, those before the first left out. */
static void scatter_wide(const point_family *f, real h, int back, int first, wide *value, wide *rows)
{
  for (int s = 0; s < f->scatters; s++) {
    const linear_loop *loop = f->scatter + s;
    const real scale = power_of(h, loop->power);
    for (int i = 0; i < loop->sites; i++)
      for (int n = 0; n < f->points; n++)
        for (int r = first; r <= B; r++)
          flow(back, rows + (loop->first + i) * (B + 1) + r,
              f->weight[n] * scale * loop->table[n * (B + 1) + r], value + n * f->results + loop->offset + i);
  }
}

/* From what v and dz say, those of them that are there, to arguments. */
static void arguments_wide(const point_family *f, real h, int back, const real *by_h, wide *v, wide *dz, wide *u)
{
  if (v)
    start_wide(f, back, by_h, v, u);
  if (dz)
    gather_wide(f, h, back, dz, u);
}

/* From v to all rows, or from dz to the last ones, by way of the points of a family; back: from these to those. Returns
 * where its slopes end. */
static const real *through_family(const point_family *f, real h, int back, const real *slopes, wide *points, wide *v,
    wide *dz, wide *rows)
{
  const real *by_h = slopes + f->points * f->arguments, *slope = by_h + f->points * f->results;
  const real *given = slope + f->points * f->slopes;
  wide *value = points + f->points * f->arguments;
  memset(points, 0, sizeof(wide) * (size_t)(f->points * (f->arguments + f->results)));
  if (back)
    scatter_wide(f, h, back, v ? 0 : B, value, rows);
  else
    arguments_wide(f, h, back, slopes, v, dz, points);
  multiply_wide(f, back, slope, points, value);
  if (v)
    given_wide(f, back, by_h, given, v, value);
  if (back)
    arguments_wide(f, h, back, slopes, v, dz, points);
  else
    scatter_wide(f, h, back, v ? 0 : B, value, rows);
  return given + f->points * f->given;
}

static void exchange_wide(wide *a, wide *b)
{
  const wide kept = *a;
  *a = *b;
  *b = kept;
}

/* The multiples of rows that made column k of the factors, of rows below it, or back; see eliminate. */
static void lower_wide(const real *a, const band *shape, const real *pivot, int k, int back, wide *x)
{
  const real *column = a + shape->first + k * shape->stride;
  if (!back)
    exchange_wide(x + k, x + (int)pivot[k]);
  for (int i = k + 1; i < least(k + shape->reach + 1, shape->rows); i++)
    flow(back, x + i, -column[i], x + k);
  if (back)
    exchange_wide(x + k, x + (int)pivot[k]);
}

/* Unknown k, known from those behind it, taken from those before it; or back. */
static void upper_wide(const real *a, const band *shape, int k, int back, wide *x)
{
  const real *column = a + shape->first + k * shape->stride;
  for (int j = 0; !back && j < WIDTH; j++)
    x[k].lane[j] *= column[k];
  for (int i = most(k - 2 * shape->reach, 0); i < k; i++)
    flow(back, x + i, -column[i], x + k);
  for (int j = 0; back && j < WIDTH; j++)
    x[k].lane[j] *= column[k];
}

/* x = a^-1 x with the factors of a, or back: of its transpose. */
static void solve_wide(const real *a, const band *shape, const real *pivot, int back, wide *x)
{
  for (int k = 0; k < shape->rows; k++)
    if (back)
      upper_wide(a, shape, k, back, x);
    else
      lower_wide(a, shape, pivot, k, back, x);
  for (int k = shape->rows - 1; k >= 0; k--)
    if (back)
      lower_wide(a, shape, pivot, k, back, x);
    else
      upper_wide(a, shape, k, back, x);
}
