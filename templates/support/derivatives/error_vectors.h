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

#define EVALUATED 0.42 /* rounding of positions in units of u: u / sqrt(3) for 1, half of it below 2 */

/* Adds, by sign 1, or takes away the rounding of the positions q at which the forces of a step are evaluated. */
static inline void round_positions(const rounding_vectors *of, const real *q, int sign, real *vectors)
{
  const real rounding = (real)(sign * EVALUATED) * of->rounding;
  unsigned long long random = of->random;
  for (int j = 0; j < of->count; j++)
    for (int i = 0; i < M; i++)
      vectors[j * of->apart + i] += (next_random(&random) >> 63 ? rounding : -rounding) * q[i];
}

/* Adds rounding errors of the numbers x, (q, p) or their increments, after step k with random signs; stores root mean
 * squares of the samples, whose squares may overflow. */
static inline void receive_roundings(rounding_vectors *of, long long k, const real *x, real *vectors)
{
  for (int i = 0; i < 2 * M; i++) {
    real largest = 0, sum = 0;
    for (int j = 0; j < of->count; j++) {
      real *to = vectors + j * of->apart + i;
      *to += (next_random(&of->random) >> 63 ? of->rounding : -of->rounding) * x[i];
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
