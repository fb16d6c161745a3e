/* Real numbers are binary32, for processors whose registers hold 32 bits. */
typedef float real;

#define MATH(function) function##f /* of libm */
#define REAL(literal) literal##f /* a number */
#define REAL_EPSILON FLT_EPSILON
#define ROUNDOFF_LEVEL 1e-4f /* updates of this relative size may be rounding: a thousand times what a sum leaves */
