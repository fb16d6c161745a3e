/* Vectors of a transported global error: the first is the error, to which the defect of each state is added; the others
 * are samples of rounding errors (Hairer, Norsett & Wanner, Solving ODEs I, II.3 and II.4). Requires: real, M; no
 * macros of numbers.h, which packages omit. */

typedef struct {
  int count;
  long long apart; /* numbers of a vector, of which the first 2M are those of (q, p) */
  double rounding; /* relative error of the states that the samples receive */
  unsigned long long random;
  const real *defects; /* (steps, 2M); NULL: none */
  long long stride; /* of the rows of errors and deviations, of which each step has a column */
  real *errors, *deviations; /* the first vectors, and root mean squares of the others, after each step */
} error_vectors;

/* The next number of a linear congruential generator (D. E. Knuth, The Art of Computer Programming 2, 3.3.4). */
static inline unsigned long long next_random(unsigned long long *x)
{
  return *x = 6364136223846793005ULL * *x + 1442695040888963407ULL;
}

/* Adds the defect of the state (q, p) after step k, and rounding errors with random signs; stores errors and root mean
 * squares of the samples, whose squares may overflow. */
static inline void receive_errors(error_vectors *of, long long k, const real *q, const real *p, real *vectors)
{
  for (int i = 0; i < 2 * M; i++) {
    const real x = i < M ? q[i] : p[i - M];
    real largest = 0, sum = 0;
    vectors[i] += of->defects ? of->defects[k * 2 * M + i] : 0;
    for (int j = 1; j < of->count; j++) {
      real *to = vectors + j * of->apart + i;
      *to += (next_random(&of->random) >> 63 ? of->rounding : -of->rounding) * x;
      const real size = *to < 0 ? -*to : *to;
      largest = size > largest ? size : largest;
    }
    for (int j = 1; largest > 0 && j < of->count; j++) {
      const real part = vectors[j * of->apart + i] / largest;
      sum += part * part;
    }
    of->errors[i * of->stride + k] = vectors[i];
    of->deviations[i * of->stride + k] = largest * (real)sqrt(sum / (of->count - 1));
  }
}
