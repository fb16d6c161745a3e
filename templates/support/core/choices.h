/* Choices between numbers of a trajectory or, if LANES is defined, in every SIMD lane by itself. */
#ifdef LANES
typedef real_bits condition __attribute__((vector_size(REAL_BYTES * LANES))); /* all bits of the lanes where it holds */

/* x in the lanes where the condition holds, y in others. */
static inline __attribute__((always_inline)) lanes where(condition holds, lanes x, lanes y)
{
  return (lanes)(((condition)x & holds) | ((condition)y & ~holds));
}

static inline __attribute__((always_inline)) int any_of(condition holds)
{
  long long any = 0;
  for (int j = 0; j < LANES; j++)
    any |= holds[j];
  return any != 0;
}

static inline __attribute__((always_inline)) int all_of(condition holds)
{
  return !any_of(~holds);
}

static inline __attribute__((always_inline)) lanes larger_number(lanes a, lanes b)
{
  return where(a > b, a, b);
}
#else
#ifndef LANES
typedef real number; /* a value of the trajectory */
#define number_of(x) ((real)(x))
#define magnitude(x) MATH(fabs)(x)
#endif
typedef int condition;
#define where(holds, x, y) ((holds) ? (x) : (y))
#define any_of(holds) (holds)
#define all_of(holds) (holds)
#define larger_number(a, b) larger(a, b)
#endif
