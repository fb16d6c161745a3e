/* Symmetric systems by L D L^T without pivots, which exists for definite matrices and those with a definite real part,
 * of which no leading block is singular (Golub & Van Loan, Matrix Computations, sec. 4.1.2 and 4.3.6; N. J. Higham,
 * Math. Comp. 67 (1998), 1591): of every lane or, with COMPLEX_SYSTEMS, every shift. Rows of the lower triangle, of a
 * full matrix or within `reach` of the diagonal: entry (k, j) is l[first + k stride + j], first = reach for a band. The
 * factors replace it, D^-1 on the diagonal; singular matrices lead to solutions that are not finite. Requires: lanes,
 * or shifts.h. */
#ifdef COMPLEX_SYSTEMS
typedef complex_shifts symmetric_entry;
#define MINUS(a, x, y) minus_product(a, x, y)
#define TIMES(x, y) product_of(x, y)
#define INVERSE(x) inverse_of_shifts(x)
#else
typedef lanes symmetric_entry;
#define MINUS(a, x, y) ((a) - (x) * (y))
#define TIMES(x, y) ((x) * (y))
#define INVERSE(x) (1 / (x))
#endif

static inline __attribute__((always_inline)) void factorise_symmetric(symmetric_entry *l, int count, int reach,
    int stride)
{
  l += stride > reach ? 0 : reach;
  for (int k = 0; k < count; k++) {
    symmetric_entry *row = l + k * stride;
    const int begin = k > reach ? k - reach : 0;
    for (int j = begin + 1; j < k; j++)
      for (int i = begin; i < j; i++)
        row[j] = MINUS(row[j], row[i], l[j * stride + i]);
    for (int j = begin; j < k; j++) {
      const symmetric_entry scaled = TIMES(row[j], l[j * stride + j]);
      row[k] = MINUS(row[k], row[j], scaled);
      row[j] = scaled;
    }
    row[k] = INVERSE(row[k]);
  }
}

/* Replaces x by the solution with these factors. */
static inline __attribute__((always_inline)) void solve_symmetric(const symmetric_entry *l, int count, int reach,
    int stride, symmetric_entry *x)
{
  l += stride > reach ? 0 : reach;
  for (int k = 1; k < count; k++)
    for (int j = k > reach ? k - reach : 0; j < k; j++)
      x[k] = MINUS(x[k], l[k * stride + j], x[j]);
  for (int k = count - 1; k >= 0; k--) {
    x[k] = TIMES(x[k], l[k * stride + k]);
    for (int j = k + reach < count ? k + reach : count - 1; j > k; j--)
      x[k] = MINUS(x[k], l[j * stride + k], x[j]);
  }
}
