/* Restarted GMRES with right preconditioning (Y. Saad, Iterative Methods for Sparse Linear Systems, 2003, algorithm
 * 9.5) on vectors over all points of all coordinates. Requires: linear_vectors.h; linear_system with count, state,
 * basis, residual, correction and product; multiply, precondition and reconsider. */

enum {
  BASIS = 16, /* basis vectors before a restart */
  MOST_CYCLES = 30 /* then Newton's method continues with the correction so far */
};

#define LINEAR_TOLERANCE 1e-6 /* relative residual: reduction per Newton iteration */
#define LINEAR_GRAIN (DBL_EPSILON / 4) /* relative to the state: a smaller residual is rounding */

/* Triangular factor of the Hessenberg matrix by Givens rotations, and the rotated right-hand side. */
typedef struct {
  double column[BASIS][BASIS + 1], cosine[BASIS], sine[BASIS], rest[BASIS + 1];
} triangle;

/* Applies the previous rotations and a new one to column k; returns the norm of the residual. */
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

/* Builds the Arnoldi basis of one cycle until the residual is below `enough`; returns its size. */
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
      const double part = inner_product(of, of->basis + j * of->count, next);
      all->column[k][j] = part;
      add_multiple(of, next, -part, of->basis + j * of->count);
    }
    all->column[k][k + 1] = sqrt(inner_product(of, next, next));
    if (all->column[k][k + 1] > 0.0)
      scale(of, next, 1.0 / all->column[k][k + 1], next);
    left = rotate(all, k);
    if (!(left > enough))
      return k + 1;
  }
  return BASIS;
}

/* Adds the solution in a basis of `size` vectors to the correction. */
static void add_combination(linear_system *of, triangle *all, int size)
{
  lanes *sum = of->basis + size * of->count;
  for (int k = size - 1; k >= 0; k--) {
    for (int j = k + 1; j < size; j++)
      all->rest[k] -= all->column[j][k] * all->rest[j];
    all->rest[k] = all->column[k][k] != 0.0 ? all->rest[k] / all->column[k][k] : 0.0;
  }
  make_zero(of, sum);
  for (int k = 0; k < size; k++)
    add_multiple(of, sum, all->rest[k], of->basis + k * of->count);
  precondition(of, sum, of->product);
  add_multiple(of, of->correction, 1.0, of->product);
}

/* Solves for the correction to LINEAR_TOLERANCE or LINEAR_GRAIN; returns the norm of the residual, which is larger if
 * further cycles do not reduce it. */
static double find_correction(linear_system *of, solver_report *report)
{
  const double size = sqrt(inner_product(of, of->residual, of->residual));
  const double enough = larger(LINEAR_TOLERANCE * size, LINEAR_GRAIN * of->state);
  double last = size;
  make_zero(of, of->correction);
  for (int cycle = 0; cycle < MOST_CYCLES; cycle++) {
    triangle all = {.rest = {0.0}};
    lanes *left = of->basis;
    scale(of, left, 1.0, of->residual);
    if (cycle > 0) {
      multiply(of, of->correction, of->product);
      add_multiple(of, left, -1.0, of->product);
    }
    all.rest[0] = sqrt(inner_product(of, left, left));
    if (!(all.rest[0] > enough && all.rest[0] < INFINITY))
      return all.rest[0];
    if (cycle > 0)
      choose_preconditioner(of, all.rest[0] / last);
    last = all.rest[0];
    scale(of, left, 1.0 / all.rest[0], left);
    add_combination(of, &all, build_basis(of, &all, enough, report));
  }
  return last;
}
