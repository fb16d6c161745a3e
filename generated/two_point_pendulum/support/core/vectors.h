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
#if POINTS < WIDEST
#define LANES POINTS
#else
#define LANES WIDEST
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

/* Vector functions from glibc's libmvec if SCVI_LIBMVEC is defined, which means that it is linked; otherwise lane by
 * lane. */
#if defined(SCVI_LIBMVEC) && defined(__x86_64__)

#if defined(__AVX512F__) && LANES >= 8
#define SCVI_PART 8
#define SCVI_NAME(f, arguments) _ZGVeN8##arguments##_##f
#elif defined(__AVX2__) && LANES >= 4
#define SCVI_PART 4
#define SCVI_NAME(f, arguments) _ZGVdN4##arguments##_##f
#else
#define SCVI_PART 2
#define SCVI_NAME(f, arguments) _ZGVbN2##arguments##_##f
#endif

#define CONSTANT __attribute__((const)) /* a function of unchanged arguments is called once */

typedef double library_part __attribute__((vector_size(8 * SCVI_PART)));
typedef union {
  lanes all;
  library_part part[LANES / SCVI_PART];
} library_view;

#define LANES_LIBRARY_FUNCTION(f)                      \
  CONSTANT library_part SCVI_NAME(f, v)(library_part); \
  static inline lanes lanes_##f(lanes x)               \
  {                                                    \
    library_view view = {x};                           \
    for (int j = 0; j < LANES / SCVI_PART; j++)        \
      view.part[j] = SCVI_NAME(f, v)(view.part[j]);    \
    return view.all;                                   \
  }                                                    \
  static inline lanes lanes_##f(lanes x)

#define LANES_LIBRARY_FUNCTION_OF_TWO(f)                              \
  CONSTANT library_part SCVI_NAME(f, vv)(library_part, library_part); \
  static inline lanes lanes_##f(lanes x, lanes y)                     \
  {                                                                   \
    library_view view = {x}, other = {y};                             \
    for (int j = 0; j < LANES / SCVI_PART; j++)                       \
      view.part[j] = SCVI_NAME(f, vv)(view.part[j], other.part[j]);   \
    return view.all;                                                  \
  }                                                                   \
  static inline lanes lanes_##f(lanes x, lanes y)

#else
#define LANES_LIBRARY_FUNCTION(f) LANES_FUNCTION(f)
#define LANES_LIBRARY_FUNCTION_OF_TWO(f) LANES_FUNCTION_OF_TWO(f)
#endif

#endif
