/* Band matrices and their LU factors. Before it: real, M, BAND, and PLACE, the place of each coordinate in the order in
 * which those that meet stand near each other. */

/* A square matrix with `blocks` unknowns a coordinate, coordinates in the order of PLACE. Those more than BAND places
 * apart do not meet: entry (i, j) is zero for |i - j| > reach. It is number first + j stride + i: a band, with room for
 * the fill-in of row exchanges, or the full matrix if that is smaller. */
typedef struct {
  int rows, reach, stride, first;
} band;

static band band_of(int blocks)
{
  const int rows = M * blocks, reach = (BAND + 1) * blocks - 1, full = 3 * reach + 1 >= rows;
  const band shape = {rows, reach, full ? rows : 3 * reach, full ? 0 : 2 * reach};
  return shape;
}

/* How many numbers the matrix has. */
static size_t band_size(const band *shape)
{
  return (size_t)shape->rows * (size_t)(shape->first ? shape->stride + 1 : shape->stride);
}

static int least(int a, int b)
{
  return a < b ? a : b;
}

static int most(int a, int b)
{
  return a > b ? a : b;
}

static void exchange(real *a, real *b)
{
  const real kept = *a;
  *a = *b;
  *b = kept;
}

/* x_i -= factor column_i for begin <= i < end. */
static inline void subtract(const real *restrict column, real factor, int begin, int end, real *restrict x)
{
  for (int i = begin; i < end; i++)
    x[i] -= factor * column[i];
}

/* Does to x what was done to the rows of the matrix at columns begin <= k < end: exchanges, subtraction of multiples.
 * */
static void eliminate(const real *a, const band *shape, const real *pivot, int begin, int end, real *x)
{
  for (int k = begin; k < end; k++) {
    if ((int)pivot[k] != k)
      exchange(x + k, x + (int)pivot[k]);
    if (x[k] != 0)
      subtract(a + shape->first + k * shape->stride, x[k], k + 1, least(k + shape->reach + 1, shape->rows), x);
  }
}

/* LU factors of the matrix, rows exchanged so that every pivot is the largest of its column. Returns 0 if one vanishes
 * or is not a number; pivot[k] is the row exchanged with k; the diagonal holds the inverses of the pivots. */
static int factorise(real *a, const band *shape, real *pivot)
{
  for (int k = 0; k < shape->rows; k++) {
    real *column = a + shape->first + k * shape->stride;
    const int end = least(k + shape->reach + 1, shape->rows);
    int best = k;
    eliminate(a, shape, pivot, most(k - 2 * shape->reach, 0), k, column);
    for (int i = k + 1; i < end; i++)
      if (MATH(fabs)(column[i]) > MATH(fabs)(column[best]))
        best = i;
    pivot[k] = (real)best;
    if (!(MATH(fabs)(column[best]) > 0))
      return 0;
    exchange(column + k, column + best);
    column[k] = 1 / column[k];
    for (int i = k + 1; i < end; i++)
      column[i] *= column[k];
  }
  return 1;
}

/* x = a^-1 x with the factors of a. */
static void back_substitute(const real *a, const band *shape, const real *pivot, real *x)
{
  eliminate(a, shape, pivot, 0, shape->rows, x);
  for (int k = shape->rows - 1; k >= 0; k--) {
    const real *column = a + shape->first + k * shape->stride;
    x[k] *= column[k];
    subtract(column, x[k], most(k - 2 * shape->reach, 0), k, x);
  }
}
