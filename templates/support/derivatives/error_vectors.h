/* Samples of transported rounding errors of a run (Hairer, Norsett & Wanner, Solving ODEs I, II.3 and II.4). Requires:
 * real, M; no macros of numbers.h, which packages omit. */

typedef struct {
  int count;
  long long apart; /* numbers of a vector, of which the first 2M are those of (q, p) */
  double rounding; /* relative error of the states that the samples receive */
  unsigned long long random;
  long long stride; /* of the rows of deviations, of which each step has a column */
  real *deviations; /* root mean squares of the samples after each step */
} rounding_vectors;

/* The next number of a linear congruential generator (D. E. Knuth, The Art of Computer Programming 2, 3.3.4). */
static inline unsigned long long next_random(unsigned long long *x)
{
  return *x = 6364136223846793005ULL * *x + 1442695040888963407ULL;
}

/* Adds rounding errors of the state (q, p) after step k with random signs; stores root mean squares of the samples,
 * whose squares may overflow. */
static inline void receive_roundings(rounding_vectors *of, long long k, const real *q, const real *p, real *vectors)
{
  for (int i = 0; i < 2 * M; i++) {
    const real x = i < M ? q[i] : p[i - M];
    real largest = 0, sum = 0;
    for (int j = 0; j < of->count; j++) {
      real *to = vectors + j * of->apart + i;
      *to += (next_random(&of->random) >> 63 ? of->rounding : -of->rounding) * x;
      const real size = *to < 0 ? -*to : *to;
      largest = size > largest ? size : largest;
    }
    for (int j = 0; largest > 0 && j < of->count; j++) {
      const real part = vectors[j * of->apart + i] / largest;
      sum += part * part;
    }
    of->deviations[i * of->stride + k] = largest * (real)sqrt(sum / of->count);
  }
}
