/* The points of a step of any number of coordinates, by Newton's iteration: (1 - h^2 A F' / m) dX = what a sweep would
 * change, where A is PRODUCT and F' the derivative of the forces at the points, of which only products with vectors are
 * made, family by family. Preconditioned by the diagonal of F', coordinate by coordinate. Before it: indexed_sweep.h;
 * products and diagonals of F'. */

typedef struct {
  const run_memory *run;
  const problem *given;
  lengths by;
  long long n, count; /* coordinates, and vectors over all points */
  section own; /* coordinates of this thread */
  const lanes *X;
  lanes *residual, *correction, *product, *forces, *inverse, *basis;
} linear_system;

/* y = x - h^2 A F' x / m. */
static void multiply(const linear_system *of, const lanes *x, lanes *y)
{
  const long long n = of->n;
  products(of->run, of->given, of->X, x, of->forces, n);
  for (long long i = of->own.first; i < of->own.end; i++) {
    const double unit = of->by.square * of->run->inverse_mass[i];
    for (int g = 0; g < GROUPS; g++)
      y[g * n + i] = x[g * n + i] - unit * given_by_all(PRODUCT, g, &of->forces[i], n);
  }
}

static void precondition(const linear_system *of, const lanes *x, lanes *y)
{
  for (long long i = of->own.first; i < of->own.end; i++)
    for (int g = 0; g < GROUPS; g++)
      y[g * of->n + i] = given_by_all(of->inverse + i * POINTS * GROUPS, g, x + i, of->n);
}

/* The inverse of a matrix by columns, in its place (Gauss and Jordan, with pivots). */
static void invert(double (*matrix)[POINTS], double (*inverse)[POINTS])
{
  for (int j = 0; j < POINTS; j++)
    for (int i = 0; i < POINTS; i++)
      inverse[j][i] = i == j;
  for (int k = 0; k < POINTS; k++) {
    int pivot = k;
    for (int i = k + 1; i < POINTS; i++)
      pivot = fabs(matrix[k][i]) > fabs(matrix[k][pivot]) ? i : pivot;
    for (int j = 0; j < POINTS; j++) {
      const double a = matrix[j][k], b = inverse[j][k];
      matrix[j][k] = matrix[j][pivot], matrix[j][pivot] = a;
      inverse[j][k] = inverse[j][pivot], inverse[j][pivot] = b;
    }
    for (int i = 0; i < POINTS; i++) {
      const double by = i == k ? 1.0 - 1.0 / matrix[k][k] : matrix[k][i] / matrix[k][k];
      for (int j = 0; j < POINTS; j++) {
        if (j != k)
          matrix[j][i] -= by * matrix[j][k];
        inverse[j][i] -= by * inverse[j][k];
      }
      matrix[k][i] = i == k ? 1.0 : 0.0;
    }
  }
}

/* 1 - h^2 A F'_ii / m of every coordinate, F'_ii being the mean over the points, inverted. */
static void find_inverses(linear_system *of)
{
  const long long n = of->n;
  diagonals(of->run, of->given, of->X, of->forces, n);
  for (long long i = of->own.first; i < of->own.end; i++) {
    double matrix[POINTS][POINTS], inverse[POINTS][POINTS], mean = 0.0;
    for (int j = 0; j < KEPT; j++)
      mean += at_point(&of->forces[i], n, j) / KEPT;
    mean = of->by.square * of->run->inverse_mass[i] * smaller(mean, 0.0);
    for (int j = 0; j < POINTS; j++)
      for (int k = 0; k < POINTS; k++)
        matrix[j][k] = (j == k) - mean * at_point(&PRODUCT[j * GROUPS], 1, k);
    invert(matrix, inverse);
    memcpy(of->inverse + i * POINTS * GROUPS, inverse, sizeof inverse);
  }
}
