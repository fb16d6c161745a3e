/* Vectors of LANES numbers, which GCC and Clang map to whatever the processor has. Before it: LANES, a power of two; or
 * POINTS, of which a vector holds what a register does, as GCC keeps longer vectors in memory. */
#pragma GCC diagnostic ignored "-Wpsabi" /* everything that takes a vector is static */
#pragma GCC diagnostic ignored "-Wmissing-braces" /* tables are the same for vectors of any length */

#if defined(__AVX512F__)
#define WIDEST 8
#elif defined(__AVX__)
#define WIDEST 4
#else
#define WIDEST 2
#endif
#ifndef LANES
#if POINTS < WIDEST
#define LANES POINTS
#else
#define LANES WIDEST
#endif
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

/* a b + c with one rounding, on which a small c has its say. */
static inline lanes multiply_add(lanes a, lanes b, lanes c)
{
  lane_view x = {a}, y = {b}, z = {c};
  for (int j = 0; j < LANES; j++)
    z.lane[j] = fma(x.lane[j], y.lane[j], z.lane[j]);
  return z.all;
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
