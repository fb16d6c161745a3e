/* Newton's iteration as one library lends it to another, which has sweeps alone. Before it: step.h. */

/* What a step is made from, its increments with their low parts, and the relative error of its end, as far as the
 * stages tell it; else not a number. */
typedef struct {
  int (*step)(const step_data *step, double *dq, double *dp, const solver_options *options, solver_report *report,
      double *error);
} fallback;
