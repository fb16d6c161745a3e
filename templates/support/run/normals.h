#include <math.h>
#include <stdint.h>

/* Normally distributed numbers that are functions of (seed, trajectory, step, purpose, index) alone: Philox4x32-10
 * (Salmon, Moraes, Dror, Shaw, SC11) of the counter (step, trajectory, purpose and index) keyed by the seed, then the
 * transform of Box and Muller (Ann. Math. Stat. 29 (1958) 610). Loops without branches, which compilers vectorise; sums
 * of products are fused explicitly, so that the bits depend neither on vectors nor on the compiler's contraction. */
enum { HEAT = 0,
  ACCEPTANCE = 1,
  COLOURED_INPUT = 2 }; /* purposes; an index is below 2^30 */
enum { NORMALS_AT_ONCE = 64 };

#if defined(__AVX2__) && defined(__GNUC__) /* one instruction, which gcc does not choose for products of 64 bits */
typedef uint64_t word_lanes __attribute__((vector_size(32)));
typedef int half_words __attribute__((vector_size(32)));
#define PRODUCT_OF_HALVES(x, y) ((word_lanes)__builtin_ia32_pmuludq256((half_words)(x), (half_words)(y)))
#else
typedef uint64_t word_lanes;
#define PRODUCT_OF_HALVES(x, y) ((uint64_t)(uint32_t)(x) * (uint32_t)(y))
#endif
enum { WORDS_AT_ONCE = sizeof(word_lanes) / sizeof(uint64_t) };

/* Counters, then random words: the lower halves. */
typedef union {
  uint64_t of[4][NORMALS_AT_ONCE];
  word_lanes lanes[4][NORMALS_AT_ONCE / WORDS_AT_ONCE];
} noise_words;

/* Philox4x32-10 of counters, two vectors at a time, so that no product waits for the last one. */
static inline void philox(uint64_t seed, int count, noise_words *words)
{
  const word_lanes none = {0}, of_a = none + 0xD2511F53u, of_c = none + 0xCD9E8D57u;
  word_lanes keys[10][2]; /* multiples of the golden ratio and of sqrt 3 - 1, as fractions of 2^32 */
  for (uint32_t round = 0; round < 10; round++)
    keys[round][0] = none + ((uint32_t)seed + round * 0x9E3779B9u),
    keys[round][1] = none + ((uint32_t)(seed >> 32) + round * 0xBB67AE85u);
  for (int from = 0; from * WORDS_AT_ONCE < count; from += 2) {
    word_lanes x[2][4];
    for (int i = 0; i < 8; i++)
      x[i / 4][i % 4] = words->lanes[i % 4][from + i / 4];
#pragma GCC unroll 10
    for (int round = 0; round < 10; round++)
      for (int i = 0; i < 2; i++) {
        const word_lanes first = PRODUCT_OF_HALVES(x[i][0], of_a), second = PRODUCT_OF_HALVES(x[i][2], of_c);
        x[i][0] = (second >> 32) ^ (x[i][1] ^ keys[round][0]), x[i][1] = second;
        x[i][2] = (first >> 32) ^ (x[i][3] ^ keys[round][1]), x[i][3] = first;
      }
    for (int i = 0; i < 8; i++)
      words->lanes[i % 4][from + i / 4] = x[i / 4][i % 4];
  }
}

/* A number or its bits. Integers below 2^52 become numbers by the bits of 2^52, as AVX2 converts none of 64 bits. */
typedef union {
  uint64_t bits;
  double value;
} number_bits;

static inline double shifted_number(uint64_t integer, double shift)
{
  const number_bits x = {integer | 0x4330000000000000u};
  return x.value - (0x1p52 + shift);
}

/* Uniform in (0, 1]: (k + 1) / 2^53 of the upper 53 bits k of two words (the lower halves), without rounding. */
static inline double uniform_of_words(uint64_t high, uint64_t low)
{
  return fma(shifted_number((uint32_t)high, 0.0), 0x1p21, shifted_number((uint32_t)low >> 11, -1.0)) * 0x1p-53;
}

/* log x for normal x > 0: x = 2^k m with m in [sqrt(1/2), sqrt 2), log m = 2 artanh s = 2 s sum_n s^(2 n) / (2 n + 1)
 * with s = (m - 1) / (m + 1), |s| < .172, so that the rest after n = 9 is 5e-17 of the first term, ln 2 in 2 words. */
static inline double log_of_uniform(double x)
{
  const uint64_t root_half = 0x3fe6a09e667f3bcdu, zero = 1023;
  const number_bits whole = {.value = x};
  const uint64_t moved = whole.bits - root_half + (zero << 52); /* k + 1023 and the fraction */
  const number_bits part = {(moved & 0xfffffffffffffu) + root_half};
  const double k = shifted_number(moved >> 52, (double)zero), s = (part.value - 1.0) / (part.value + 1.0);
  const double square = s * s;
  double sum = 2.0 / 19;
#pragma GCC unroll 8
  for (int n = 17; n > 1; n -= 2)
    sum = fma(sum, square, 2.0 / n);
  const double rest = fma(s * square, sum, k * 0x1.abc9e3b39803fp-56); /* ln 2 less its high word */
  return fma(k, 0x1.62e42fefa39efp-1, fma(2.0, s, rest));
}

/* cos and sin of 2 pi k / 2^53, k the upper 53 bits of two words: the nearest quarter of a turn, and the series of
 * Taylor in the rest, |y| <= pi / 4, whose first omitted terms are below 5e-17 of the sums. */
static inline void cos_and_sin_of_words(uint64_t high, uint64_t low, double *cosine, double *sine)
{
  const uint64_t turned = high + 0x20000000u, sign = 0x8000000000000000u; /* bits 30 and 31: the quarter */
  const double rest = shifted_number(turned & 0x3fffffffu, 0x1p29), lower = shifted_number((uint32_t)low >> 11, 0.0);
  const double y = 6.283185307179586 * (fma(rest, 0x1p21, lower) * 0x1p-53), square = y * y;
  double c = 1.0 / 20922789888000, s = -1.0 / 1307674368000;
  c = fma(c, square, -1.0 / 87178291200), s = fma(s, square, 1.0 / 6227020800);
  c = fma(c, square, 1.0 / 479001600), s = fma(s, square, -1.0 / 39916800);
  c = fma(c, square, -1.0 / 3628800), s = fma(s, square, 1.0 / 362880);
  c = fma(c, square, 1.0 / 40320), s = fma(s, square, -1.0 / 5040);
  c = fma(c, square, -1.0 / 720), s = fma(s, square, 1.0 / 120);
  c = fma(c, square, 1.0 / 24), s = fma(s, square, -1.0 / 6);
  c = fma(fma(c, square, -0.5), square, 1.0), s = fma(s * square, y, y);
  number_bits first = {.value = turned & 0x40000000u ? s : c}, second = {.value = turned & 0x40000000u ? c : s};
  first.bits ^= (turned + 0x40000000u) << 32 & sign, second.bits ^= turned << 32 & sign;
  *cosine = first.value, *sine = second.value;
}

/* Normals of `steps` steps from a step on, of indices begin .. begin + count - 1 and of `width` trajectories: first[k]
 * and second[k], one for the half step before and one for the half step after the step, with k = ((step) count + index)
 * width + trajectory. They are fused with 0, so that no product is part of a caller's sum. */
static inline void normals(uint64_t seed, uint64_t step, int steps, uint32_t purpose, int begin, int count,
    uint32_t trajectory, int width, double *restrict first, double *restrict second)
{
  noise_words x;
  double length[NORMALS_AT_ONCE];
  const int total = steps * count * width;
  for (int from = 0, index = 0, lane = 0, size; from < total; from += size, first += size, second += size) {
    size = total - from < NORMALS_AT_ONCE ? total - from : NORMALS_AT_ONCE;
    const int filled = width == 1 && index + size <= count ? size - 1 : 0; /* in a loop without branches */
    for (int i = 0; i < filled; i++) {
      x.of[0][i] = (uint32_t)step, x.of[1][i] = (uint32_t)(step >> 32), x.of[2][i] = trajectory;
      x.of[3][i] = purpose << 30 | (uint32_t)(begin + index + i);
    }
    index += filled;
    for (int i = filled; i < size; i++) {
      x.of[0][i] = (uint32_t)step, x.of[1][i] = (uint32_t)(step >> 32), x.of[2][i] = trajectory + (uint32_t)lane;
      x.of[3][i] = purpose << 30 | (uint32_t)(begin + index);
      lane = lane + 1 < width ? lane + 1 : 0;
      index += lane == 0;
      step += index == count;
      index = index < count ? index : 0;
    }
    philox(seed, size, &x);
    for (int i = 0; i < size; i++)
      length[i] = -2.0 * log_of_uniform(uniform_of_words(x.of[0][i], x.of[1][i]));
    for (int i = 0; i < size; i++)
      length[i] = sqrt(length[i]);
    for (int i = 0; i < size; i++) {
      double cosine, sine;
      cos_and_sin_of_words(x.of[2][i], x.of[3][i], &cosine, &sine);
      first[i] = fma(length[i], cosine, 0.0), second[i] = fma(length[i], sine, 0.0);
    }
  }
}

/* Uniform in (0, 1] of a purpose in a step, of at most NORMALS_AT_ONCE trajectories. */
static inline void uniform_numbers(uint64_t seed, uint64_t step, uint32_t purpose, uint32_t trajectory, int count,
    double *chances)
{
  noise_words x;
  for (int i = 0; i < count; i++)
    x.of[0][i] = (uint32_t)step, x.of[1][i] = (uint32_t)(step >> 32), x.of[2][i] = trajectory + (uint32_t)i,
    x.of[3][i] = purpose << 30;
  philox(seed, count, &x);
  for (int i = 0; i < count; i++)
    chances[i] = uniform_of_words(x.of[0][i], x.of[1][i]);
}
