/* Parameters of the comparison of a step with two steps of half its size. */

#define COMPARED 512 /* one of so many steps is compared */
#define FALLBACK_COMPARED 8 /* one of so many steps that the fixed-point iteration did not solve */
#define DOUBTFUL REAL(4.0) /* steps whose error estimate exceeds the largest one so far by this factor (squared) are
                            * compared */
#define RESOLVED_STEP REAL(1e-6) /* relative to the state: if the halves differ by more, those of the first half are
                                  * compared */
#define MOST_HALVINGS 24
#define GROSS_DIFFERENCE REAL(10.0) /* relative to the state: beyond it the step is a spurious solution */
#define ROUNDING_OF_HALVES (64 * REAL_EPSILON)
#define SMALL_PART REAL(0.1) /* of the largest momentum: smaller changes count as little */
