/* Real numbers are binary64. */
typedef double real;

#define MATH(function) function /* of libm */
#define REAL(literal) literal /* a number */
#define REAL_EPSILON DBL_EPSILON
#define ROUNDOFF_LEVEL 1e-11 /* updates of this relative size may be rounding: a thousand times what a sum leaves */
