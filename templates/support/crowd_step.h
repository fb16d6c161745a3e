/* What a step of many trajectories is made from and what it answers. Before it: the header, NAME, STATUS, vectors.h. */
enum {
  OK = STATUS(OK),
  NOT_FINITE = STATUS(FAILED)
};

typedef NAME(options) solver_options;
typedef NAME(block) block_memory;

/* What sweeps did: which trajectories they still serve, and how many there were. */
typedef struct {
  double *active;
  long long sweeps;
} solver_report;

/* Everything a step is made from. */
typedef struct {
  double t, h;
  const lanes *q0, *p0, *carry_q, *carry_p, *parameters;
} step_data;
