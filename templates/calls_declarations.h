struct NAME(step_control); /* of adaptive steps */

/* Arguments and results of a run as one struct, for callers by which each argument of a call costs time. */
typedef struct {
  NAME(run) * run;
  const double *parameters;
  const NAME(options) *options;
  double *t, *q, *p; /* memory for states: `words` numbers for t, `coordinates` numbers for q and for p */
  int *iterations;
  const double *start; /* t, q and p, or velocities, at the start of a run */
  double *sizes; /* of the steps that follow the states, unless NULL */
  NAME(report) * report;
  double *workspace;
  const struct NAME(step_control) *control; /* adaptive steps to t_end; NULL: fixed steps of h */
  double h, t_end;
  long long words, coordinates, measures_growth, has_energies, begins_by; /* velocities: 1; on constraints: 2 more */
  double tolerable; /* error of a step, or change of energy, without a warning */
  double error, error_t, energies[2];
  long long stored, steps, rejected, fallback_steps, remarks; /* remarks: 1 if there may be a warning */
} NAME(call);
int NAME(call_advance)(const NAME(call) *call, long long steps, long long every);
int NAME(call_integrate)(NAME(call) *call, long long steps, long long every);
int NAME(call_pieces)(NAME(call) *call, long long count, const double *t, const double *h, const long long *pieces,
    const double *q, const double *p, double *q1, double *p1);

/* Arguments and results of trajectories that are integrated one after the other. */
typedef struct {
  NAME(run) * run, *before; /* of the present trajectory; copy to which it returns if it requests Newton's method */
  const NAME(options) *options;
  const struct NAME(step_control) *control; /* adaptive steps; NULL: fixed steps, in segments */
  const double *q, *p, *parameters, *t_end; /* of all trajectories; t_end: of adaptive steps */
  const long long *segment_steps, *segment_every;
  const double *segment_h, *segment_end; /* step size from there on; of two words: end of a single step, or NaN */
  double *times, *positions, *momenta; /* memory for states */
  int *iterations;
  double *actions; /* memory for the actions up to the states, unless NULL */
  int *status; /* of all trajectories, -1 before their end */
  long long *stored, *done, *fallback_steps; /* numbers of states and of steps of all trajectories */
  double *energies; /* of all trajectories at both ends, unless NULL */
  NAME(report) * report;
  double *workspace, t, t_low;
  long long words, coordinates, parameters_each, segments, every, capacity; /* words: of a time */
  long long rows, next, end, segment, left, requested; /* states in memory; present trajectory, its segment */
  unsigned long long seed;
  long long trajectory, metropolis; /* of the noise in a heat bath: stream of the first trajectory */
  long long pauses, entered; /* with `pauses`, calls end where a segment begins: parameters may change */
} NAME(each);
long long NAME(call_each)(NAME(each) *call, long long steps);
long long NAME(call_transform)(int to_velocities, long long count, long long m, const double *t, const double *q,
    const double *x, const double *parameters, double *y, double *workspace);
long long NAME(call_momenta)(long long count, double t, long long m, long long parameters_each, const double *q,
    const double *v, const double *parameters, double *p, double *workspace);
void NAME(call_project)(long long count, double t, long long m, long long parameters_each, const double *q,
    const double *p, const double *parameters, double *q1, double *p1, double *apart, double *workspace);
