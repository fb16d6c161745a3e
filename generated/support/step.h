/* What a step is made from. Before it: answers.h, real. */
typedef NAME(run) run_memory;

/* Everything a step is made from. */
typedef struct {
  real t, h;
  const real *q0, *p0, *carry_q, *carry_p, *parameters;
  real *scratch; /* SCRATCH numbers */
  int first; /* whether the workspace holds nothing of the step before */
  const struct guess_tables *tables; /* that continue the curve of former steps; NULL: those of steps of one length */
} step_data;
