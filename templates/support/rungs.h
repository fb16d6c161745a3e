/* Lengths of steps that choose their own, roots of 2 to the power of a rung: how long one is, and how its error tells
 * that of the next. Before it: MANTISSA; GROWTH, what a rung up multiplies the error of a curve by; ERROR_POWER. After
 * it: a trial of a step, trials.h. */
enum {
  OCTAVE = sizeof MANTISSA / sizeof *MANTISSA, /* rungs */
  MOST_UP = 4 * OCTAVE, /* rungs, while the first step is looked for */
  MOST_DOWN = 2 * OCTAVE /* after a step that failed */
};

#define USED_PART REAL(0.5) /* of the error allowed, what a longer step may be expected to use */
#define FEW_POWERS REAL(4.5) /* of an octave, in the error of a curve of two coefficients that bend it, or one */
#define LITTLE REAL(0.5) /* of the error that lets a step be two rungs longer: less is not measured */
#define LAST_STEP REAL(1e-6) /* a step that ends so near the end, as a part of it, ends there */
#define FIRST_STEP REAL_EPSILON /* of the whole span: the first step tried */
#define ROUNDOFF_ERROR (REAL(0.03125) * REAL_EPSILON) /* of a step: a million add up to what rounding leaves */
#define LEAST_UNRESOLVED (REAL(65536.0) * REAL_EPSILON * REAL_EPSILON) /* of a curve: less is rounding */
#ifndef ITERATION_PART
#define ITERATION_PART REAL(0.00390625) /* of the error allowed to a step: that of its stage equations */
#endif

/* A rung up multiplies the error of a curve by GROWTH. A step is too long beyond `most`, and may be a rung longer below
 * `few`, two below `fewer`. */
typedef struct {
  real most, few, fewer;
  real decay; /* from a coefficient of a curve to the next, where its error is just allowed */
} error_limits;

/* Where the highest coefficient is the second that bends a curve, an error is its fourth power: the one below is all
 * that bends it, as little as the step is short. Of more, the least decay is taken, as if a step might bend all. */
static error_limits limits_of(real tolerance)
{
  const real most = larger(MATH(pow)(tolerance, 1 / ERROR_POWER), LEAST_UNRESOLVED);
  const real power = (real)OCTAVE * MATH(log2)(GROWTH);
  const error_limits limits = {most, most * USED_PART / GROWTH, most * USED_PART / (GROWTH * GROWTH),
      MATH(exp2)(MATH(log2)(most) / (power > FEW_POWERS ? power - 2 : power))};
  return limits;
}

static real length_of(long long rung)
{
  const long long octave = rung >= 0 ? rung / OCTAVE : -((OCTAVE - 1 - rung) / OCTAVE);
  return MATH(ldexp)(MANTISSA[rung - octave * OCTAVE], (int)octave);
}

/* The longest rung that is not longer than h > 0. */
static long long rung_below(real h)
{
  int exponent;
  long long rung;
  MATH(frexp)(h, &exponent);
  for (rung = (long long)exponent * OCTAVE; length_of(rung) > h; rung--)
    ;
  return rung;
}

/* The error of a curve, had its step been so many rungs longer. */
static inline real error_at(real error, int rungs)
{
  for (; rungs > 0; rungs--)
    error *= GROWTH;
  for (; rungs < 0; rungs++)
    error /= GROWTH;
  return error;
}

/* By how many rungs the next step is longer; shorter by an octave at most. The error is expected to go on growing as it
 * did; where it fell, much of that may have been luck. */
static int next_change(real error, real before, const error_limits *limits)
{
  const real expected =
      before > 0 && error > before ? error * (error / before) : larger(error, before / (GROWTH * GROWTH));
  int change = expected < limits->fewer ? 2 : expected < limits->few;
  while (change > -OCTAVE && error_at(expected, change) > limits->most)
    change--;
  return change;
}

/* The length of the next step, or the rest of the way where that is hardly longer, which then is the last. */
static real next_length(real length, real rest, int *last)
{
  *last = length * (1 + LAST_STEP) >= MATH(fabs)(rest);
  return *last ? rest : MATH(copysign)(length, rest);
}
