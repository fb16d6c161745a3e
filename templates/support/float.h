/* Real numbers are binary32, for processors whose registers hold 32 bits. */
typedef float real;

#define MATH(function) function##f /* of libm */
#define REAL(literal) literal##f /* a number */
#define REAL_EPSILON FLT_EPSILON
#define REAL_MIN FLT_MIN
#define NEGLIGIBLE 5e-4f /* of displacements relative to the state: rounding leaves no curve of them */
#define EACH REAL_EPSILON /* of the largest coordinate: what each counts as, where each is to be exact by itself */
#define ALL 1 /* and where the state is to be exact as a whole */
#define DECAY 0.1f /* from a coefficient of a curve to the next, where the curve is resolved to some digits */
#define VANISHING 1e-10f /* beside the time, which has two of them: a motion with such steps ends in a singularity */
#define ROUNDOFF_LEVEL 1e-4f /* updates of this relative size may be rounding: a thousand times what a sum leaves */
