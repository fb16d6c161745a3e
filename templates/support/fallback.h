/* Newton solver that one library provides to another, which has only the fixed-point iteration. Requires: step.h. */

/* Computes the increments of a step with their low words, and the relative error of its end if the stages determine it,
 * otherwise NaN. */
typedef struct {
  int (*step)(const step_data *step, double *dq, double *dp, const solver_options *options, solver_report *report,
      double *error);
} fallback;
