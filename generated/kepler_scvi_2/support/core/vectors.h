#ifndef SUPPORT_VECTORS_H
#define SUPPORT_VECTORS_H

/* Vectors of LANES numbers (GCC and Clang vector extensions). Requires: LANES, a power of two; or POINTS, of which a
 * vector contains as many as a register, since GCC stores longer vectors in memory. */
#pragma GCC diagnostic ignored "-Wpsabi" /* all functions with vector arguments are static */
#pragma GCC diagnostic ignored "-Wmissing-braces" /* tables are the same for vectors of any length */

#if defined(__AVX512F__)
#define WIDEST 8
#elif defined(__AVX__)
#define WIDEST 4
#else
#define WIDEST 2
#endif
#if defined(__AVX512F__) && LANES >= 8 && !defined(__clang__)
#pragma GCC target("prefer-vector-width=512") /* loops over lanes become whole vectors, not halves */
#endif

typedef double lanes __attribute__((vector_size(8 * LANES)));
typedef union {
  lanes all;
  double lane[LANES];
} lane_view;

static inline lanes lanes_of(double x)
{
  const lanes zero = {0.0};
  return zero + x;
}

/* Fused a b + c: a small c affects the rounding. */
static inline lanes multiply_add(lanes a, lanes b, lanes c)
{
  lane_view x = {a}, y = {b}, z = {c};
  for (int j = 0; j < LANES; j++)
    z.lane[j] = fma(x.lane[j], y.lane[j], z.lane[j]);
  return z.all;
}

static inline lanes larger_lanes(lanes a, lanes b)
{
  lane_view x = {a}, y = {b};
  for (int j = 0; j < LANES; j++)
    x.lane[j] = y.lane[j] > x.lane[j] ? y.lane[j] : x.lane[j];
  return x.all;
}

/* lanes_f, the function f of libm lane by lane; ends in a declaration, for the semicolon. */
#define LANES_FUNCTION(f)                \
  static inline lanes lanes_##f(lanes x) \
  {                                      \
    lane_view view = {x};                \
    for (int j = 0; j < LANES; j++)      \
      view.lane[j] = f(view.lane[j]);    \
    return view.all;                     \
  }                                      \
  static inline lanes lanes_##f(lanes x)

#define LANES_FUNCTION_OF_TWO(f)                     \
  static inline lanes lanes_##f(lanes x, lanes y)    \
  {                                                  \
    lane_view view = {x}, other = {y};               \
    for (int j = 0; j < LANES; j++)                  \
      view.lane[j] = f(view.lane[j], other.lane[j]); \
    return view.all;                                 \
  }                                                  \
  static inline lanes lanes_##f(lanes x, lanes y)

/* Vectors of inverse roots x^(-k/2), k odd: LANES_INVERSE_ROOT(k, y^k from y and square = y^2, inverse^((k+1)/2))
 * defines lanes_inverse_root_k. AVX-512 estimates y = x^(-1/2) to 14 bits; with e = 1 - x y^2 the correction is the
 * series of (1 - e)^(-k/2). Elsewhere by division and square root. */
#if defined(__AVX512F__) && LANES >= 8
#define ROOT_LANES 8
#define ESTIMATE_INVERSE_ROOT __builtin_ia32_rsqrt14pd512_mask
#elif defined(__AVX512VL__) && LANES == 4
#define ROOT_LANES 4
#define ESTIMATE_INVERSE_ROOT __builtin_ia32_rsqrt14pd256_mask
#endif

#ifdef ROOT_LANES

static inline lanes lanes_estimate_inverse_root(lanes x)
{
  typedef double part __attribute__((vector_size(8 * ROOT_LANES)));
  const part zero = {0.0};
  union {
    lanes all;
    part parts[LANES / ROOT_LANES];
  } view = {x};
  for (int j = 0; j < LANES / ROOT_LANES; j++)
    view.parts[j] = ESTIMATE_INVERSE_ROOT(view.parts[j], zero, 255);
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

#endif
