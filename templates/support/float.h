/* Real numbers in single precision (binary32), for processors with 32-bit floating-point registers. */
typedef float real;

#define MATH(function) function##f /* function of libm */
#define REAL(literal) literal##f /* floating-point literal */
#define REAL_EPSILON FLT_EPSILON
#define REAL_MIN FLT_MIN
#define NEGLIGIBLE 5e-4f /* relative to the state: rounding leaves no resolvable curve of smaller displacements */
#define EACH REAL_EPSILON /* share of the largest coordinate in each size, if each coordinate is to be accurate by
                           * itself */
#define ALL 1 /* the same if the state is to be accurate as a whole */
#define DECAY 0.1f /* ratio of successive coefficients of a curve that is resolved to some digits */
/* relative to t, which has two words: steps below it indicate a singularity of the motion */
#define SMALLEST_RELATIVE_STEP 1e-10f
#define ROUNDOFF_LEVEL 1e-4f /* relative updates below it may be rounding errors: 1000 times those of a sum */
