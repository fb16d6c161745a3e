/* When a step is compared with two of half its length, and what their difference means. */

#define COMPARED 512 /* steps, of which one is compared */
#define FALLBACK_COMPARED 8 /* steps that sweeps did not solve, of which one is */
#define DOUBTFUL REAL(4.0) /* times the largest error yet, squared as that of a curve: such a step is */
#define RESOLVED_STEP REAL(1e-6) /* of the state: where halves differ by more, those of the first half are compared */
#define MOST_HALVINGS 24
#define GROSS_DIFFERENCE REAL(10.0) /* times the state: beyond it a step is no motion */
#define ROUNDING_OF_HALVES (64 * REAL_EPSILON)
