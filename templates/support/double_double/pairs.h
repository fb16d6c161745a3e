/* Double-double arithmetic of numbers or of vectors of them (Dekker 1971; Joldes, Muller & Popescu 2017): a PAIR is the
 * unrounded sum of its high and its low word. This text is included for each NUMBER, with the names of its functions
 * by OF. It needs IEEE arithmetic as written: contraction to FMA is harmless, reassociation is not. */
typedef struct {
  NUMBER high, low;
} PAIR;

INLINE PAIR OF(word)(NUMBER x)
{
  return (PAIR){x, BROADCAST(0.0)};
}

INLINE PAIR OF(two_sum)(NUMBER a, NUMBER b)
{
  const NUMBER sum = a + b, part = sum - a;
  return (PAIR){sum, (a - (sum - part)) + (b - part)};
}

/* The same for |a| >= |b| or a = 0. */
INLINE PAIR OF(fast_two_sum)(NUMBER a, NUMBER b)
{
  const NUMBER sum = a + b;
  return (PAIR){sum, b - (sum - a)};
}

INLINE PAIR OF(two_product)(NUMBER a, NUMBER b)
{
  const NUMBER product = a * b;
  return (PAIR){product, FMA(a, b, -product)};
}

/* Relative error 3 u^2 (u = 2^-53), also if the high words cancel. */
INLINE PAIR OF(add)(PAIR a, PAIR b)
{
  const PAIR high = OF(two_sum)(a.high, b.high), low = OF(two_sum)(a.low, b.low);
  const PAIR sum = OF(fast_two_sum)(high.high, high.low + low.high);
  return OF(fast_two_sum)(sum.high, sum.low + low.low);
}

/* Pair arithmetic (Lange & Rump 2020): low words need not be below the rounding error of high words, as those of sums
 * that cancel, which `settled` repairs. The error is 4 u^2 relative to |a| + |b|. */
INLINE PAIR OF(sum)(PAIR a, PAIR b)
{
  PAIR result = OF(two_sum)(a.high, b.high);
  result.low += a.low + b.low;
  return result;
}

INLINE PAIR OF(settled)(PAIR a)
{
  return OF(fast_two_sum)(a.high, a.low);
}

/* a + b to an error of 4 u^2 relative to |a| + |b|, with half the operations of the sum above. */
INLINE PAIR OF(plus)(PAIR a, PAIR b)
{
  return OF(settled)(OF(sum)(a, b));
}

INLINE PAIR OF(negative)(PAIR a)
{
  return (PAIR){-a.high, -a.low};
}

INLINE PAIR OF(difference)(PAIR a, PAIR b)
{
  return OF(sum)(a, OF(negative)(b));
}

INLINE PAIR OF(subtract)(PAIR a, PAIR b)
{
  return OF(add)(a, OF(negative)(b));
}

/* Products, whose low words are up to 3 u of the high ones if those of settled factors are. */
INLINE PAIR OF(product)(PAIR a, PAIR b)
{
  PAIR result = OF(two_product)(a.high, b.high);
  result.low = FMA(a.high, b.low, FMA(a.low, b.high, result.low));
  return result;
}

/* With one word. */
INLINE PAIR OF(multiple)(PAIR a, NUMBER b)
{
  PAIR result = OF(two_product)(a.high, b);
  result.low = FMA(a.low, b, result.low);
  return result;
}

/* With a power of two, exactly. */
INLINE PAIR OF(times_power)(PAIR a, NUMBER b)
{
  return (PAIR){a.high * b, a.low * b};
}

/* With the square of the low word: terms of one sign must be added to a product before that is rounded, here and below,
 * since a mean rounding error of 1e-33 lets the energies of some orbits drift. */
INLINE PAIR OF(squared)(PAIR a)
{
  PAIR result = OF(two_product)(a.high, a.high);
  result.low += FMA(a.high + a.high, a.low, a.low * a.low);
  return result;
}

INLINE PAIR OF(multiply)(PAIR a, PAIR b)
{
  return OF(settled)(OF(product)(a, b));
}

INLINE PAIR OF(scale)(PAIR a, NUMBER b)
{
  return OF(settled)(OF(multiple)(a, b));
}

INLINE PAIR OF(square)(PAIR a)
{
  return OF(settled)(OF(squared)(a));
}

/* The quotient of the high words, corrected twice, since one correction leaves its own rounding error, 2^-105. */
INLINE PAIR OF(divide)(PAIR a, PAIR b)
{
  const NUMBER first = a.high / b.high;
  const PAIR rest = OF(subtract)(a, OF(scale)(b, first));
  const NUMBER second = rest.high / b.high;
  const NUMBER third = OF(subtract)(rest, OF(scale)(b, second)).high / b.high;
  const PAIR sum = OF(fast_two_sum)(first, second);
  return OF(fast_two_sum)(sum.high, sum.low + third);
}

/* A positive number with the sign of another. */
INLINE PAIR OF(copysign)(PAIR size, PAIR x)
{
  return OF(times_power)(size, OF(sign)(x.high));
}

/* The nearest whole number: that of the high word, of two the one towards the low word, and that of the low word. */
INLINE PAIR OF(rint)(PAIR x)
{
  return OF(fast_two_sum)(OF(whole)(x.high, x.low), OF(whole)(x.low, BROADCAST(0.0)));
}

/* 1 / x, corrected by a series. */
INLINE PAIR OF(inverse)(PAIR x)
{
  const NUMBER y = 1.0 / x.high, e = FMA(-x.high, y, BROADCAST(1.0)) - x.low * y;
  return OF(fast_two_sum)(y, FMA(y, e, y * e * e));
}

/* The root of the high word, corrected; 0 for 0, where the correction would be 0/0. */
INLINE PAIR OF(sqrt)(PAIR x)
{
  const NUMBER y = OF(root)(x.high);
  const NUMBER half = 0.5 / (y + DBL_MIN), rest = FMA(-y, y, x.high) + x.low, low = rest * half;
  return OF(fast_two_sum)(y, FMA(rest, half, -half * low * low));
}

/* x^(-1/2) from y = x.high^(-1/2): with e = 1 - x y^2 by the series of (1 - e)^(-1/2). */
INLINE PAIR OF(inverse_root_1)(PAIR x)
{
  const NUMBER y = 1.0 / OF(root)(x.high);
  const PAIR square = OF(two_product)(y, y), product = OF(two_product)(x.high, square.high);
  const NUMBER e = (1.0 - product.high) - (product.low + FMA(x.high, square.low, x.low * square.high));
  return OF(fast_two_sum)(y, FMA(0.5 * y, e, 0.375 * y * e * e));
}

INLINE PAIR OF(inverse_root_3)(PAIR x)
{
  const PAIR y = OF(inverse_root_1)(x);
  return OF(multiply)(y, OF(square)(y));
}

INLINE PAIR OF(inverse_root_5)(PAIR x)
{
  const PAIR y = OF(inverse_root_1)(x);
  return OF(multiply)(y, OF(square)(OF(square)(y)));
}

INLINE PAIR OF(inverse_root_7)(PAIR x)
{
  const PAIR y = OF(inverse_root_1)(x), square = OF(square)(y);
  return OF(multiply)(OF(multiply)(y, square), OF(square)(square));
}
