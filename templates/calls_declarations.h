/* Arguments and results of a run as one struct, for callers by which each argument of a call costs time. */
typedef struct {
  NAME(run) * run;
  const double *parameters;
  const NAME(options) *options;
  double *t, *q, *p; /* memory for states */
  int *iterations;
  const double *start; /* t, q and p at the start of a run */
  double *sizes; /* of the steps that follow the states, unless NULL */
  NAME(report) * report;
  double *workspace;
  double h, t_end, tolerance; /* h = 0: adaptive steps */
  long long coordinates, measures_growth, has_energies;
  double error, error_t, energies[2];
  long long stored, steps, rejected;
} NAME(call);
int NAME(call_advance)(const NAME(call) *call, long long steps, long long every);
int NAME(call_integrate)(NAME(call) *call, long long steps, long long every);
