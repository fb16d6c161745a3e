/* Real numbers are binary64. */
typedef double real;

#define MATH(function) function /* of libm */
#define REAL(literal) literal /* a number */
#define REAL_EPSILON DBL_EPSILON
#define REAL_MIN DBL_MIN
#define NEGLIGIBLE 1e-12 /* of displacements relative to the state: rounding leaves no curve of them */
#define EACH REAL_EPSILON /* of the largest coordinate: what each counts as, where each is to be exact by itself */
#define ALL 1 /* and where the state is to be exact as a whole */
#define VANISHING 1e-22 /* beside the time, which has two of them: a motion with such steps ends in a singularity */
#define ROUNDOFF_LEVEL 1e-11 /* updates of this relative size may be rounding: a thousand times what a sum leaves */
