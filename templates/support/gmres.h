/* Linear systems that are known by their products alone: GMRES, restarted (Y. Saad, Iterative Methods for Sparse Linear
 * Systems, 2003, algorithm 9.5: preconditioned from the right), on vectors over all points of all coordinates. Before
 * it: points.h; linear_system with count, basis, residual, correction and product; multiply and precondition. */

enum {
  BASIS = 16, /* vectors until it begins anew */
  MOST_CYCLES = 30 /* then Newton goes on with what there is */
};

#define LINEAR_TOLERANCE 1e-6 /* of a system, relative: so much an iteration of Newton's gains */

static double inner_product(const lanes *x, const lanes *y, long long count)
{
  lanes a = lanes_of(0.0), b = lanes_of(0.0);
  long long i = 0;
  for (; i + 1 < count; i += 2) {
    a += x[i] * y[i];
    b += x[i + 1] * y[i + 1];
  }
  for (; i < count; i++)
    a += x[i] * y[i];
  return lanes_total(a + b);
}

/* y += by x. */
static void add_multiple(lanes *restrict y, double by, const lanes *restrict x, long long count)
{
  for (long long i = 0; i < count; i++)
    y[i] += by * x[i];
}

static void scale(lanes *x, double by, long long count)
{
  for (long long i = 0; i < count; i++)
    x[i] *= by;
}

/* The triangle that Givens' rotations make of the products of the basis with itself, and what they make of the norm. */
typedef struct {
  double column[BASIS][BASIS + 1], cosine[BASIS], sine[BASIS], rest[BASIS + 1];
} triangle;

/* Column k after the rotations before it and one of its own; returned is the norm of what the basis leaves over. */
static double rotate(triangle *of, int k)
{
  double *column = of->column[k], length;
  for (int j = 0; j < k; j++) {
    const double upper = column[j], lower = column[j + 1];
    column[j] = of->cosine[j] * upper + of->sine[j] * lower;
    column[j + 1] = of->cosine[j] * lower - of->sine[j] * upper;
  }
  length = sqrt(column[k] * column[k] + column[k + 1] * column[k + 1]);
  of->cosine[k] = length > 0.0 ? column[k] / length : 1.0;
  of->sine[k] = length > 0.0 ? column[k + 1] / length : 0.0;
  column[k] = length;
  of->rest[k + 1] = -of->sine[k] * of->rest[k];
  of->rest[k] *= of->cosine[k];
  return fabs(of->rest[k + 1]);
}

/* The basis of one cycle, until what it leaves over is small enough; how many vectors it has. */
static int build_basis(linear_system *of, triangle *all, double enough, solver_report *report)
{
  for (int k = 0; k < BASIS; k++) {
    const lanes *now = of->basis + k * of->count;
    lanes *next = of->basis + (k + 1) * of->count;
    double left;
    precondition(of, now, of->product);
    multiply(of, of->product, next);
    report->products++;
    for (int j = 0; j <= k; j++) {
      const double part = inner_product(of->basis + j * of->count, next, of->count);
      all->column[k][j] = part;
      add_multiple(next, -part, of->basis + j * of->count, of->count);
    }
    all->column[k][k + 1] = sqrt(inner_product(next, next, of->count));
    if (all->column[k][k + 1] > 0.0)
      scale(next, 1.0 / all->column[k][k + 1], of->count);
    left = rotate(all, k);
    if (!(left > enough))
      return k + 1;
  }
  return BASIS;
}

/* Adds what a basis of so many vectors gives to the correction. */
static void add_combination(linear_system *of, triangle *all, int size)
{
  lanes *sum = of->basis + size * of->count;
  for (int k = size - 1; k >= 0; k--) {
    for (int j = k + 1; j < size; j++)
      all->rest[k] -= all->column[j][k] * all->rest[j];
    all->rest[k] = all->column[k][k] != 0.0 ? all->rest[k] / all->column[k][k] : 0.0;
  }
  memset(sum, 0, sizeof(lanes) * (size_t)of->count);
  for (int k = 0; k < size; k++)
    add_multiple(sum, all->rest[k], of->basis + k * of->count, of->count);
  precondition(of, sum, of->product);
  add_multiple(of->correction, 1.0, of->product, of->count);
}

/* The correction whose product is the residual, as nearly as LINEAR_TOLERANCE. */
static void find_correction(linear_system *of, solver_report *report)
{
  const double size = sqrt(inner_product(of->residual, of->residual, of->count));
  memset(of->correction, 0, sizeof(lanes) * (size_t)of->count);
  for (int cycle = 0; cycle < MOST_CYCLES; cycle++) {
    triangle all = {.rest = {0.0}};
    lanes *left = of->basis;
    if (cycle > 0)
      multiply(of, of->correction, left);
    for (long long i = 0; i < of->count; i++)
      left[i] = cycle > 0 ? of->residual[i] - left[i] : of->residual[i];
    all.rest[0] = sqrt(inner_product(left, left, of->count));
    if (!(all.rest[0] > LINEAR_TOLERANCE * size && all.rest[0] < INFINITY))
      return;
    scale(left, 1.0 / all.rest[0], of->count);
    add_combination(of, &all, build_basis(of, &all, LINEAR_TOLERANCE * size, report));
  }
}
