/* lanes_inverse_root_k, x^(-k/2) of vectors, k odd: LANES_INVERSE_ROOT(k, y^k from y and square = y^2,
 * inverse^((k+1)/2)). AVX-512 has the inverse root y to 14 bits; with e = 1 - x y^2 the rest is the series of (1 -
 * e)^(-k/2). Elsewhere by division and root. Before it: vectors.h. */
#if defined(__AVX512F__) && LANES % 8 == 0

static inline lanes lanes_estimate_inverse_root(lanes x)
{
  typedef double part __attribute__((vector_size(64)));
  const part zero = {0.0};
  union {
    lanes all;
    part parts[LANES / 8];
  } view = {x};
  for (int j = 0; j < LANES / 8; j++)
    view.parts[j] = __builtin_ia32_rsqrt14pd512_mask(view.parts[j], zero, 255);
  return view.all;
}

#define LANES_INVERSE_ROOT(k, powers, inverses)                                                          \
  static inline lanes lanes_inverse_root_##k(lanes x)                                                    \
  {                                                                                                      \
    const double a = 0.5 * k, b = a * (a + 1.0) / 2.0, c = b * (a + 2.0) / 3.0, d = c * (a + 3.0) / 4.0; \
    const lanes y = lanes_estimate_inverse_root(x), square = y * y, e = 1.0 - x * square;                \
    const lanes power = powers, first = a + b * e, then = c + d * e;                                     \
    return power + (power * e) * (first + (e * e) * then);                                               \
  }                                                                                                      \
  static inline lanes lanes_inverse_root_##k(lanes x)

#else

static inline lanes lanes_root(lanes x)
{
  lane_view view = {x};
  for (int j = 0; j < LANES; j++)
    view.lane[j] = sqrt(view.lane[j]);
  return view.all;
}

#define LANES_INVERSE_ROOT(k, powers, inverses)       \
  static inline lanes lanes_inverse_root_##k(lanes x) \
  {                                                   \
    const lanes inverse = 1.0 / x;                    \
    return inverses * lanes_root(x);                  \
  }                                                   \
  static inline lanes lanes_inverse_root_##k(lanes x)

#endif
