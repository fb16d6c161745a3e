#include "../core/numbers.h"
#include <limits.h>

/* Step-size control. Step sizes of adaptive steps are roots of 2 to the power of a grid level, and the error estimate
 * of a step determines the level of the next. Requires: MANTISSA; GROWTH, the factor of the error estimate per level;
 * ERROR_POWER. Include before a trial of a step and trials.h. */
enum {
  LEVELS_PER_BINADE = sizeof MANTISSA / sizeof *MANTISSA, /* levels per factor of two */
  MOST_UP = 4 * LEVELS_PER_BINADE, /* levels, while the first step size is determined */
  MOST_DOWN = 2 * LEVELS_PER_BINADE, /* after a step whose error was too large, or a first step that failed */
  DOWN_FAILED = LEVELS_PER_BINADE, /* after a step whose iteration failed */
  AVOIDED = 32 /* steps after it that stay below its size */
};

#define USED_PART REAL(0.5) /* of the admissible error: predicted error of an increased step */
#define FEW_POWERS REAL(4.5) /* growth of the error estimate over a factor of two, in powers of 2, for a curve of two
                              * coefficients or one */
#define LITTLE REAL(0.5) /* of the error with which a step may be three levels larger: smaller ones are not
                          * distinguished */
#define LAST_STEP REAL(1e-6) /* relative to the step: a step that ends so near t_end ends at t_end */
#define FIRST_STEP REAL_EPSILON /* of the whole span: first trial step size */
#ifdef DOUBLE_DOUBLE
#define ROUNDOFF_ERROR (64.0 * REAL_EPSILON * REAL_EPSILON) /* errors below are rounding errors of the estimate */
#else
#define ROUNDOFF_ERROR (REAL(0.125) * REAL_EPSILON) /* of a step, relative to its motion: the sum over a run is of the
                                                     * size of
                                                       * rounding errors */
#endif
#ifdef DOUBLE_DOUBLE
#define LEAST_UNRESOLVED (64.0 * REAL_EPSILON * REAL_EPSILON)
#else
#define LEAST_UNRESOLVED (REAL(65536.0) * REAL_EPSILON * REAL_EPSILON) /* of a curve: smaller values are rounding
                                                                        * errors */
#endif
#define NO_LARGEST_LEVEL (1LL << 62)
#ifndef ITERATION_PART
#define ITERATION_PART REAL(0.0625) /* tolerance of stage equations relative to that of a step: by trial, between
                                     * 1/64 and 1/4, which takes a tenth fewer iterations, with errors up to twice as
                                     * large in the mean and 25 times in single runs */
#endif

/* Limits of the error estimate: a step above `most` is rejected; below `few` the next step may be one level larger,
 * below `fewer` two; errors below `least` count as that. */
typedef struct {
  real most, few, fewer, least;
  real decay; /* ratio of successive coefficients of a curve whose error is just admissible */
} error_limits;

/* If the leading coefficient is the second one that contributes to the curvature, the error is proportional to its
 * fourth power, since the lower one, which is small for short steps, is the only other one. With more coefficients the
 * smallest decay is assumed. */
static error_limits limits_of(real tolerance)
{
  const real most = larger(MATH(pow)(tolerance, 1 / ERROR_POWER), LEAST_UNRESOLVED);
  const real power = (real)LEVELS_PER_BINADE * MATH(log2)(GROWTH);
  const real few = most * USED_PART / GROWTH, fewer = few / GROWTH;
  return (error_limits){most, few, fewer, LITTLE * fewer / GROWTH,
      MATH(exp2)(MATH(log2)(most) / (power > FEW_POWERS ? power - 2 : power))};
}

/* 2^k, by the exponent of binary64: a call of ldexp takes as long as an iteration of a small system. */
static inline real power_of_two(int k)
{
#ifndef SINGLE_PRECISION
  const unsigned long long bits = (unsigned long long)(k + 1023) << 52;
  real power;
  memcpy(&power, &bits, sizeof power);
  if (k > -1023 && k < 1024)
    return power;
#endif
  return MATH(ldexp)(1, k);
}

static real size_of_level(long long grid_level)
{
  const long long below = -((LEVELS_PER_BINADE - 1 - grid_level) / LEVELS_PER_BINADE);
  const long long binary_level = grid_level >= 0 ? grid_level / LEVELS_PER_BINADE : below;
  return MANTISSA[grid_level - binary_level * LEVELS_PER_BINADE] * power_of_two((int)binary_level);
}

/* Largest level whose step size does not exceed h > 0. */
static long long level_below(real h)
{
  int exponent;
  long long grid_level;
  MATH(frexp)(h, &exponent);
  for (grid_level = (long long)exponent * LEVELS_PER_BINADE; size_of_level(grid_level) > h; grid_level--)
    ;
  return grid_level;
}

/* Largest level of step sizes up to max_step, which may be infinite. */
static long long largest_level(real max_step)
{
  return max_step < INFINITY ? level_below(max_step) : NO_LARGEST_LEVEL;
}

/* Error estimate if the step size were `levels` larger on the grid. */
static inline real error_at(real error, int levels)
{
  for (; levels > 0; levels--)
    error *= GROWTH;
  for (; levels < 0; levels++)
    error /= GROWTH;
  return error;
}

/* Size of the next step, or the remaining interval if that is hardly longer; *last is then 1. */
static real next_size(real length, real rest, int *last)
{
  *last = length * (1 + LAST_STEP) >= MATH(fabs)(rest);
  return *last ? rest : MATH(copysign)(length, rest);
}
