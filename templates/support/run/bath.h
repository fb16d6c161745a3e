#include "../core/numbers.h"
#include "normals.h"

/* Heat bath at frozen positions: the exact step of dp = -R M^-1 (p - A) dt + sqrt(2 kT) R^(1/2) dW + sigma dW' over a
 * time tau. With M = L L^T and S = L^-1 R L^-T = U diag(k) U^T, y = V (p - A), V = U^T L^-1, are independent
 * processes of Ornstein and Uhlenbeck, y <- e^(-k tau) y + sqrt(kT (1 - e^(-2 k tau))) U^T xi, and p = A + W y,
 * W = L U. U^T makes the noise a function of S that is continuous where eigenvalues k are equal and U is arbitrary.
 * Momenta along the normals G^T of constraints do not change: S is projected on their complement, where k = 0. The
 * kinetic energy is |y|^2 / 2. Requires: the kernel bath_terms, and block, row and column of its entries. */

#define DEPENDENT_NORMAL 1e-12 /* squared rest of a normal relative to its square: it depends on the others */
#define NO_FRICTION 1e-14 /* relative to the largest k: it is 0 but for rounding */
#define JACOBI_SWEEPS 30
#define FEW_ITERATIONS 7 /* of a step: to a root near the initial guess */

/* W, V and U^T of each block, n rows of n numbers, the decay e^(-k tau) - 1 and the strength of the noise of each y,
 * and the root of tau: of a trajectory, or of those in SIMD lanes. */
#define FACTORS_OF(number)                                                                                       \
  struct {                                                                                                       \
    number terms[BATH_TERMS], w[BATH_FACTORS], v[BATH_FACTORS], turn[BATH_FACTORS], decay[M], strength[M], root; \
  }
typedef FACTORS_OF(double) bath_factors;
#ifdef MANY_TRAJECTORIES
typedef lanes bath_number;
typedef FACTORS_OF(lanes) present_factors;
#else
typedef double bath_number;
typedef bath_factors present_factors;
#endif
enum {
  DRAWN = M + STRENGTHS, /* normals of a half step */
  NUMBERS_DRAWN = DRAWN * (int)(sizeof(bath_number) / sizeof(double)),
  STEPS_DRAWN = NUMBERS_DRAWN < NORMALS_AT_ONCE ? NORMALS_AT_ONCE / NUMBERS_DRAWN : 1 /* at once */
};

static inline void rotate(double *x, double *y, double c, double s)
{
  const double first = *x;
  *x = c * first - s * *y;
  *y = s * first + c * *y;
}

/* Makes S diagonal by cyclic Jacobi rotations (Golub & Van Loan, sec. 8.5), which also act on W = L, V = L^-1 and 1,
 * which becomes U^T. */
static inline void diagonalise(int n, double *s, double *w, double *v, double *turn)
{
  for (int i = 0; i < n; i++)
    turn[i * n + i] = 1;
  for (int sweep = 0, rotated = LARGEST_BLOCK > 1; sweep < JACOBI_SWEEPS && rotated; sweep++) {
    rotated = 0;
    for (int i = 0; i < n; i++)
      for (int j = i + 1; j < n; j++) {
        const double entry = s[i * n + j], a = s[i * n + i], b = s[j * n + j], theta = (b - a) / (2 * entry);
        const double tangent = copysign(1 / (fabs(theta) + sqrt(theta * theta + 1)), theta);
        const double c = 1 / sqrt(tangent * tangent + 1);
        if (!(fabs(entry) > DBL_EPSILON / 8 * sqrt(fabs(a * b))))
          continue;
        rotated = 1;
        for (int k = 0; k < n; k++) {
          rotate(&s[k * n + i], &s[k * n + j], c, tangent * c);
          rotate(&w[k * n + i], &w[k * n + j], c, tangent * c);
          rotate(&v[i * n + k], &v[j * n + k], c, tangent * c);
          rotate(&turn[i * n + k], &turn[j * n + k], c, tangent * c);
        }
        for (int k = 0; k < n; k++)
          rotate(&s[i * n + k], &s[j * n + k], c, tangent * c);
      }
  }
}

/* Replaces the lower triangle of M by L and computes L^-1; returns 0 unless M is positive definite. */
static inline int root_and_inverse(int n, double *l, double *inverse)
{
  for (int j = 0; j < n; j++)
    for (int i = j; i < n; i++) {
      for (int k = 0; k < j; k++)
        l[i * n + j] -= l[i * n + k] * l[j * n + k];
      if (i == j && !(l[j * n + j] > 0))
        return 0;
      l[i * n + j] = i == j ? sqrt(l[j * n + j]) : l[i * n + j] / l[j * n + j];
    }
  for (int j = 0; j < n; j++)
    for (int i = j; i < n; i++) {
      double sum = i == j;
      for (int k = j; k < i; k++)
        sum -= l[i * n + k] * inverse[k * n + j];
      inverse[i * n + j] = sum / l[i * n + i];
    }
  return 1;
}

static inline double dot(int n, const double *x, const double *y)
{
  double sum = 0;
  for (int i = 0; i < n; i++)
    sum += x[i] * y[i];
  return sum;
}

/* S <- P S P of a block, P = 1 - sum c c^T over an orthonormal basis of its normals L^-1 G^T (Gram and Schmidt,
 * twice). */
static inline void project_on_tangents(int block, int n, const double *entries, const double *inverse, double *s)
{
  double basis[NORMAL_ROWS + 1][LARGEST_BLOCK], image[LARGEST_BLOCK];
  for (int row = 0, count = 0; row < NORMAL_ROWS; row++) {
    double *c = basis[count], square, along;
    memset(c, 0, sizeof basis[0]);
    for (int e = 0; e < BATH_NORMAL_ENTRIES; e++)
      for (int i = 0; i < n && BATH_NORMAL[e][0] == block && BATH_NORMAL[e][1] == row; i++)
        c[i] += inverse[i * n + BATH_NORMAL[e][2]] * entries[e];
    square = dot(n, c, c);
    for (int k = 0; k < 2 * count; k++) {
      along = dot(n, c, basis[k % count]);
      for (int i = 0; i < n; i++)
        c[i] -= along * basis[k % count][i];
    }
    if (!(dot(n, c, c) > DEPENDENT_NORMAL * square))
      continue;
    square = sqrt(dot(n, c, c));
    for (int i = 0; i < n; i++)
      c[i] /= square;
    for (int i = 0; i < n; i++)
      image[i] = dot(n, s + i * n, c);
    along = dot(n, image, c);
    for (int i = 0; i < n; i++)
      for (int j = 0; j < n; j++)
        s[i * n + j] += along * c[i] * c[j] - image[i] * c[j] - c[i] * image[j];
    count++;
  }
}

/* Computes the factors of half a step of h; returns 0 if kT < 0 or the mass matrix is not positive definite. */
static int prepare_bath(bath_factors *bath, double t, double h, const double *q, const double *parameters)
{
  memset(bath, 0, sizeof *bath);
  const double temperature = (bath_terms(q, t, parameters, bath->terms), bath->terms[0]);
  const double *mass = bath->terms + 1 + M, *friction = mass + BATH_MASS_ENTRIES;
  double *w = bath->w, *v = bath->v, *turn = bath->turn;
  const double tau = fabs(h) / 2;
  bath->root = sqrt(tau);
  for (int b = 0, first = 0, n; b < BLOCKS; b++, w += n * n, v += n * n, turn += n * n, first += n) {
    double s[LARGEST_BLOCK * LARGEST_BLOCK] = {0}, largest = 0;
    n = BLOCK_SIZE[b];
    for (int e = 0; e < BATH_MASS_ENTRIES; e++)
      if (BATH_MASS[e][0] == b)
        w[BATH_MASS[e][1] * n + BATH_MASS[e][2]] = mass[e];
    if (!root_and_inverse(n, w, v))
      return 0;
    for (int e = 0; e < BATH_FRICTION_ENTRIES; e++)
      for (int k = 0; k < n * n && BATH_FRICTION[e][0] == b; k++) {
        const double *x = v + k / n * n, *y = v + k % n * n;
        const int i = BATH_FRICTION[e][1], j = BATH_FRICTION[e][2];
        s[k] += friction[e] * (x[i] * y[j] + (i != j ? x[j] * y[i] : 0));
      }
    project_on_tangents(b, n, friction + BATH_FRICTION_ENTRIES, v, s);
    diagonalise(n, s, w, v, turn);
    for (int i = 0; i < n; i++)
      largest = fmax(largest, fabs(s[i * n + i]));
    for (int i = 0; i < n; i++) {
      const double rate = fabs(s[i * n + i]) > NO_FRICTION * largest ? s[i * n + i] : 0;
      bath->decay[BLOCK_COORDINATE[first + i]] = expm1(-rate * tau);
      bath->strength[BLOCK_COORDINATE[first + i]] = sqrt(-temperature * expm1(-2 * rate * tau));
    }
  }
  return temperature >= 0 && all_finite(bath->terms, BATH_TERMS) && all_finite(bath->strength, M);
}

/* y = A x of the coordinates of a block. */
static inline void multiply_block(int n, const int *at, const bath_number *a, const bath_number *x, bath_number *y)
{
  for (int i = 0; i < n; i++) {
    bath_number sum = a[i * n] * x[at[0]];
    for (int k = 1; k < n; k++)
      sum += a[i * n + k] * x[at[k]];
    y[at[i]] = sum;
  }
}

/* x + low += increment, as add_compensated. */
static inline void add_to_state(bath_number *x, bath_number *low, bath_number increment)
{
  const bath_number sum = *x + increment, part = sum - *x;
  const bath_number rest = ((*x - (sum - part)) + (increment - part)) + *low;
  *x = sum + rest;
  *low = rest - (*x - sum);
}
