/* Elementary functions of pairs, accurate to 1e-30 relative: sin, cos and exp by a table and a Taylor polynomial, the
 * others by one correction of a double or by identities without cancellation. This text is included for each NUMBER
 * after pairs.h, with the operations on single words: PICK(k, table, column), an entry of row k; OF(power_of_2)(k), 2^k
 * of k / 64 rounded down; OF(limited)(x, most), x within -most and most; OF(angle)(x), NaN if |x| > 1e9;
 * OF(is_small)(x), 1 if |x| < 1/4, else 0; OF(sign)(x); and log, atan2 and asinh of libm as OF(log_of) etc. */
static inline PAIR OF(constant)(const double *words)
{
  return (PAIR){BROADCAST(words[0]), BROADCAST(words[1])};
}

/* x - k unit for a unit of three words; k is the nearest whole number to x / unit, so that the first difference is
 * exact. */
static inline PAIR OF(reduced)(PAIR x, NUMBER k, const double *unit)
{
  const PAIR a = OF(two_product)(k, BROADCAST(unit[0])), b = OF(two_product)(k, BROADCAST(unit[1]));
  const PAIR low = OF(two_sum)(x.low, -a.low), high = OF(two_sum)(x.high - a.high, low.high);
  const PAIR rest = OF(two_sum)(high.high, -b.high);
  return OF(two_sum)(rest.high, (rest.low + high.low) + (low.low - FMA(k, BROADCAST(unit[2]), b.low)));
}

/* Polynomial in a small x: `pairs` coefficients of two words, then `singles` of one. */
static inline PAIR OF(polynomial)(PAIR x, const double (*c)[2], int pairs, int singles)
{
  NUMBER tail = BROADCAST(c[pairs + singles - 1][0]);
  for (int n = pairs + singles - 2; n >= pairs; n--)
    tail = FMA(tail, x.high, BROADCAST(c[n][0]));
  PAIR sum = OF(sum)(OF(constant)(c[pairs - 1]), OF(two_product)(tail, x.high));
  for (int n = pairs - 2; n >= 0; n--)
    sum = OF(sum)(OF(constant)(c[n]), OF(product)(sum, x));
  return sum;
}

/* Sine and cosine: of k pi / 64 by a table, of the rest by polynomials. */
static inline void OF(sine_and_cosine)(PAIR x, PAIR *sine, PAIR *cosine)
{
  const NUMBER k = (OF(angle)(x.high) * PER_UNIT_OF_ANGLE + TO_INTEGER) - TO_INTEGER;
  const PAIR rest = OF(reduced)(x, k, UNIT_OF_ANGLE), square = OF(squared)(rest);
  const PAIR s = OF(sum)(rest, OF(product)(OF(product)(rest, square), OF(polynomial)(square, SINE, 3, 4)));
  const PAIR c = OF(product)(square, OF(polynomial)(square, COSINE, 3, 4)); /* cos - 1 */
  const PAIR S = {PICK(k, CIRCLE, 0), PICK(k, CIRCLE, 1)}, C = {PICK(k, CIRCLE, 2), PICK(k, CIRCLE, 3)};
  *sine = OF(plus)(S, OF(sum)(OF(product)(C, s), OF(product)(S, c))); /* S and C are 0 or 0.049 at least, s 0.025 */
  *cosine = OF(plus)(C, OF(difference)(OF(product)(C, c), OF(product)(S, s)));
}

static inline PAIR OF(sin)(PAIR x)
{
  PAIR sine, cosine;
  OF(sine_and_cosine)(x, &sine, &cosine);
  return sine;
}

static inline PAIR OF(cos)(PAIR x)
{
  PAIR sine, cosine;
  OF(sine_and_cosine)(x, &sine, &cosine);
  return cosine;
}

static inline PAIR OF(tan)(PAIR x)
{
  PAIR sine, cosine;
  OF(sine_and_cosine)(x, &sine, &cosine);
  return OF(divide)(sine, cosine);
}

/* e^x, and e^x - 1 without cancellation: with x = k log(2) / 64 + r, e^x - 1 = (T - 1) + T (e^r - 1), where T - 1 of
 * small k is tabulated. */
static inline PAIR OF(exp_and_rest)(PAIR x, PAIR *less_1)
{
  const NUMBER k = (OF(limited)(x.high, 800.0) * PER_UNIT_OF_EXPONENT + TO_INTEGER) - TO_INTEGER;
  const NUMBER near = OF(limited)(k, 32.0), scale = OF(power_of_2)(k), chosen = OF(are_equal)(k, near);
  const PAIR r = OF(reduced)(x, k, UNIT_OF_EXPONENT);
  const PAIR e = OF(plus)(r, OF(multiply)(OF(square)(r), OF(polynomial)(r, EXPONENTIAL, 5, 6)));
  const PAIR T = {PICK(k, POWERS, 0) * scale, PICK(k, POWERS, 1) * scale}, small = OF(multiply)(T, e);
  const PAIR far = OF(add)(T, OF(word)(BROADCAST(-1.0)));
  const PAIR T_1 = {OF(select)(chosen, PICK(near, POWERS_LESS_1, 0), far.high),
      OF(select)(chosen, PICK(near, POWERS_LESS_1, 1), far.low)};
  *less_1 = OF(add)(T_1, small);
  return OF(add)(T, small);
}

static inline PAIR OF(exp)(PAIR x)
{
  PAIR less_1;
  return OF(exp_and_rest)(x, &less_1);
}

/* y = log x.high, corrected by log(1 + z) of z = x e^-y - 1; near 1 z is (x - 1) + x (e^-y - 1). */
static inline PAIR OF(log)(PAIR x)
{
  const NUMBER y = OF(log_of)(x.high), small = OF(is_small)(y);
  PAIR less_1;
  const PAIR e = OF(exp_and_rest)(OF(word)(-y), &less_1), x_1 = OF(add)(x, OF(word)(BROADCAST(-1.0)));
  const PAIR near = OF(add)(x_1, OF(multiply)(x, less_1));
  const PAIR far = OF(add)(OF(multiply)(x, e), OF(word)(BROADCAST(-1.0)));
  const PAIR z = {OF(select)(small, near.high, far.high), OF(select)(small, near.low, far.low)};
  return OF(add)(OF(two_sum)(y, z.high), OF(word)(z.low - 0.5 * z.high * z.high));
}

/* The relative error grows with |y log x| u^2. */
static inline PAIR OF(pow)(PAIR x, PAIR y)
{
  return OF(exp)(OF(multiply)(y, OF(log)(x)));
}

static inline PAIR OF(sinh)(PAIR x)
{
  PAIR less_1;
  const PAIR e = OF(exp_and_rest)(x, &less_1);
  return OF(scale)(OF(add)(less_1, OF(divide)(less_1, e)), BROADCAST(0.5));
}

static inline PAIR OF(cosh)(PAIR x)
{
  const PAIR e = OF(exp)(x);
  return OF(scale)(OF(add)(e, OF(divide)(OF(word)(BROADCAST(1.0)), e)), BROADCAST(0.5));
}

/* -w / (2 + w) with w = exp(-2 |x|) - 1, and the sign of x. */
static inline PAIR OF(tanh)(PAIR x)
{
  const NUMBER sign = OF(sign)(x.high);
  PAIR w;
  (void)OF(exp_and_rest)(OF(scale)(x, -2.0 * sign), &w);
  return OF(scale)(OF(divide)(w, OF(add)(w, OF(word)(BROADCAST(2.0)))), -sign);
}

/* y = asinh x.high, corrected by Newton's method with its second-order term. */
static inline PAIR OF(asinh)(PAIR x)
{
  const NUMBER y = OF(asinh_of)(x.high);
  PAIR less_1;
  const PAIR e = OF(exp_and_rest)(OF(word)(y), &less_1), inverse = OF(divide)(OF(word)(BROADCAST(1.0)), e);
  const PAIR sine = OF(scale)(OF(add)(less_1, OF(multiply)(less_1, inverse)), BROADCAST(0.5));
  const NUMBER cosine = 0.5 * (e.high + inverse.high);
  const PAIR change = OF(divide)(OF(subtract)(x, sine), OF(word)(cosine));
  const NUMBER curved = 0.5 * change.high * change.high * (sine.high / cosine);
  return OF(add)(OF(two_sum)(y, change.high), OF(word)(change.low - curved));
}

/* 2 asinh sqrt((x - 1) / 2) */
static inline PAIR OF(acosh)(PAIR x)
{
  const PAIR half = OF(scale)(OF(add)(x, OF(word)(BROADCAST(-1.0))), BROADCAST(0.5));
  return OF(scale)(OF(asinh)(OF(sqrt)(half)), BROADCAST(2.0));
}

/* sqrt(1 - x^2) */
static inline PAIR OF(other_side)(PAIR x)
{
  const PAIR one = OF(word)(BROADCAST(1.0));
  return OF(sqrt)(OF(multiply)(OF(subtract)(one, x), OF(add)(one, x)));
}

static inline PAIR OF(atanh)(PAIR x)
{
  return OF(asinh)(OF(divide)(x, OF(other_side)(x)));
}

/* a = atan2(y.high, x.high), corrected by the angle of (x, y) turned by -a. */
static inline PAIR OF(atan2)(PAIR y, PAIR x)
{
  const NUMBER a = OF(atan2_of)(y.high, x.high);
  PAIR s, c;
  OF(sine_and_cosine)(OF(word)(a), &s, &c);
  const PAIR rest = OF(divide)(OF(subtract)(OF(multiply)(y, c), OF(multiply)(x, s)),
      OF(add)(OF(multiply)(x, c), OF(multiply)(y, s)));
  return OF(add)(OF(word)(a), rest);
}

static inline PAIR OF(atan)(PAIR x)
{
  return OF(atan2)(x, OF(word)(BROADCAST(1.0)));
}

static inline PAIR OF(asin)(PAIR x)
{
  return OF(atan2)(x, OF(other_side)(x));
}

static inline PAIR OF(acos)(PAIR x)
{
  return OF(atan2)(OF(other_side)(x), x);
}
