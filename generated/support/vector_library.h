/* Functions of whole vectors by glibc's libmvec where SCVI_LIBMVEC says that it is linked, else lane by lane. Before
 * it: vectors.h. */
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

typedef double library_part __attribute__((vector_size(8 * SCVI_PART)));
typedef union {
  lanes all;
  library_part part[LANES / SCVI_PART];
} library_view;

#define LANES_LIBRARY_FUNCTION(f)                   \
  library_part SCVI_NAME(f, v)(library_part);       \
  static inline lanes lanes_##f(lanes x)            \
  {                                                 \
    library_view view = {x};                        \
    for (int j = 0; j < LANES / SCVI_PART; j++)     \
      view.part[j] = SCVI_NAME(f, v)(view.part[j]); \
    return view.all;                                \
  }                                                 \
  static inline lanes lanes_##f(lanes x)

#define LANES_LIBRARY_FUNCTION_OF_TWO(f)                            \
  library_part SCVI_NAME(f, vv)(library_part, library_part);        \
  static inline lanes lanes_##f(lanes x, lanes y)                   \
  {                                                                 \
    library_view view = {x}, other = {y};                           \
    for (int j = 0; j < LANES / SCVI_PART; j++)                     \
      view.part[j] = SCVI_NAME(f, vv)(view.part[j], other.part[j]); \
    return view.all;                                                \
  }                                                                 \
  static inline lanes lanes_##f(lanes x, lanes y)

#else
#define LANES_LIBRARY_FUNCTION(f) LANES_FUNCTION(f)
#define LANES_LIBRARY_FUNCTION_OF_TWO(f) LANES_FUNCTION_OF_TWO(f)
#endif
