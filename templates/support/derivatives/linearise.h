#include "error_vectors.h"
#include "jvp_and_vjp.h"

/* Tangent and adjoint vectors over steps solved by Newton's method. */

#define LEFT_TO_COME (DBL_EPSILON * DBL_EPSILON / 16.0) /* squared: relative change still to come that is accepted */

typedef struct stored_curves stored_curves;

/* Steps and the vectors propagated over them, of shape (steps + 1, count, STEP_INPUTS); of rounding errors only
 * those at both ends of the present step, (2, count, STEP_INPUTS). */
typedef struct {
  const real *t, *h, *q, *p, *parameters;
  const solver_options *options;
  int back, count;
  rounding_vectors *errors; /* samples of a run; NULL: others */
  const stored_curves *curves; /* of the steps, which are solved otherwise */
  real *vectors, *q1, *p1, *workspace;
  solver_report *report;
  real accepted; /* squared: relative change of vectors still to come that is accepted */
  long long guess; /* number of previous steps that the predictor uses (fixed-point iteration only) */
  int look; /* first iteration of the linearised equations whose convergence is tested */
} propagation;

/* Propagation by the arguments of a function. */
#define PROPAGATION_OF_ARGUMENTS                                                                              \
  .t = t, .h = h, .q = q, .p = p, .parameters = parameters, .options = options ? options : &STANDARD_OPTIONS, \
  .workspace = workspace, .report = report

static step_data step_of(const propagation *over, long long k, const real *nothing)
{
  return step_from(over->t[k], over->h[k], over->q + k * M, over->p + k * M, nothing, nothing,
      over->parameters, over->workspace);
}

/* Vectors at the start of step k; step k propagates them from there to k + 1, or back. */
static real *vectors_at(const propagation *over, long long k)
{
  return over->vectors + (over->errors ? k % 2 : k) * over->count * STEP_INPUTS;
}

/* Propagates the vectors from index `first` on over step k. */
static int vectors_by_newton(propagation *over, long long k, int first)
{
  const real nothing[M] = {0};
  const step_data step = step_of(over, k, nothing);
  linearised_step at = linearised_in(&step, over->workspace);
  over->report->t = step.t;
  over->guess = 0;
  TRY(linearise_step(&at, over->options, over->q1 ? over->q1 + k * M : NULL, over->q1 ? over->p1 + k * M : NULL,
      over->report));
  return propagate_vectors(&at, over->back, over->count - first, vectors_at(over, k + over->back) + first * STEP_INPUTS,
      vectors_at(over, k + !over->back) + first * STEP_INPUTS);
}

#ifdef VECTORS_BY_ITERATION
/* Tangent and adjoint vectors over steps that are solved by fixed-point iteration. Blocks of STEPS_AT_ONCE steps are
 * solved first, each with a predictor from the previous one; then the vectors are propagated, forward or backward.
 * Newton's method takes over where an iteration fails. Requires: iteration, store_step, linearise_points,
 * vary_step and vjp_by_iteration, the iteration and its linearisation. */

static double *stored_of(const propagation *over, long long k)
{
  return over->workspace + LINEARISED + k * STORED_OF_STEP;
}

/* Solves the step with the predictor, then without it. Returns 1 on success. */
static int solve_by_iteration(propagation *over, const step_data *step, const iteration_data *data, double *dq,
    double *dp)
{
  for (int tries = over->guess > 0 ? 2 : 1; tries > 0; tries--) {
    if (fixed_point(step, data, over->workspace + SCRATCH, &over->guess, dq, dp, over->options, over->report) == OK)
      return 1;
    over->guess = 0;
  }
  return 0;
}

/* Solves step k and stores it; returns 0 if the iteration fails. */
static int solve_and_store(propagation *over, long long k, double *kept)
{
  const double nothing[M] = {0.0};
  const step_data step = step_of(over, k, nothing);
  double dq[2 * M] = {0.0}, dp[2 * M] = {0.0}; /* increments, then their low words */
  iteration_data data;
  prepare_iteration(&step, &data);
  over->report->t = step.t;
  if (!solve_by_iteration(over, &step, &data, dq, dp))
    return 0;
  for (int i = 0; over->q1 && i < M; i++) {
    over->q1[k * M + i] = step.q0[i] + (dq[i] + dq[M + i]);
    over->p1[k * M + i] = step.p0[i] + (dp[i] + dp[M + i]);
  }
  store_step(&step, &data, over->workspace + SCRATCH, dq, dp, kept);
  return 1;
}

/* Values that another method keeps at `count` abscissae in each step, for each coordinate, those of this method: forces
 * or velocities; and the table from them to the points. */
struct stored_curves {
  int count;
  const double *values;
  const lanes *table;
};

/* Table from values at abscissae to the points, by Lagrange's formula. */
static void tabulate_points(int count, const double *abscissae, lanes *table)
{
  for (int j = 0; j < count; j++)
    for (int n = 0; n < GROUPS; n++) {
      lanes product = lanes_of(1.0);
      for (int k = 0; k < count; k++)
        if (k != j)
          product *= (ABSCISSA[n] - abscissae[k]) / (abscissae[j] - abscissae[k]);
      TABLE_ENTRY(table, n, j) = product;
    }
}

/* Stores step k as that which its curve solves; returns 0 if that is unknown. */
static int store_curve(const propagation *over, long long k, double *kept)
{
  const stored_curves *curves = over->curves;
  const double nothing[M] = {0.0}, *values = curves->values + k * M * curves->count;
  const step_data step = step_of(over, k, nothing);
  double memory[M * POINTS];
  iteration_data data;
  if (curves->count == 0 || !all_finite(values, M * curves->count))
    return 0;
  for (int i = 0; i < M; i++, values += curves->count)
    for (int n = 0; n < GROUPS; n++) {
      lanes value = lanes_of(0.0);
      for (int j = 0; j < curves->count; j++)
        value += TABLE_ENTRY(curves->table, n, j) * values[j];
      memcpy(memory + i * POINTS + n * LANES, &value, sizeof value);
    }
  prepare_iteration(&step, &data);
  store_step(&step, &data, memory, nothing, nothing, kept);
  return 1;
}

/* Stores steps first <= k < end, by their curves or solved; returns 0 if the iteration fails for one of them. */
static int store_steps(propagation *over, long long first, long long end)
{
  for (long long k = first; k < end; k++) {
    double *kept = stored_of(over, k - first);
    if (over->curves && store_curve(over, k, kept))
      over->guess = 0;
    else if (!solve_and_store(over, k, kept))
      return 0;
  }
  return 1;
}

/* Products of the Jacobian of a step and one vector, or as many as are iterated together. */
static __attribute__((noinline)) int jvp_by_iteration(iterated_step *at, double *v, int *look)
{
  return vary_step(at, 1, (double (*)[STEP_INPUTS])v, look);
}

static __attribute__((noinline)) int jvps_by_iteration(iterated_step *at, double *v, int *look)
{
  return vary_step(at, VECTORS_AT_ONCE, (double (*)[STEP_INPUTS])v, look);
}

/* Propagates the vectors over a solved step; returns the number propagated before an iteration failed. */
static int propagate_by_iteration(propagation *over, long long k, const double *kept)
{
  const double nothing[M] = {0.0}, *from = vectors_at(over, k + over->back);
  const step_data step = step_of(over, k, nothing);
  double *to = vectors_at(over, k + !over->back);
  iteration_data data;
  iterated_step at;
  prepare_iteration(&step, &data);
  linearise_points(&step, &data, kept, &at);
  at.accepted = over->accepted;
  for (int j = 0, own; j < over->count; j += own) {
    double v[VECTORS_AT_ONCE * STEP_INPUTS];
    own = over->errors && over->count - j >= VECTORS_AT_ONCE ? VECTORS_AT_ONCE : 1;
    memcpy(v, from + j * STEP_INPUTS, sizeof(double) * (size_t)(own * STEP_INPUTS));
    if ((over->back ? vjp_by_iteration : own > 1 ? jvps_by_iteration
                                                 : jvp_by_iteration)(&at, v, &over->look) != OK)
      return j;
    for (int i = 0; i < own * STEP_INPUTS; i++)
      to[j * STEP_INPUTS + i] += v[i];
  }
  return over->count;
}
#else
/* Tangent and adjoint vectors over steps that are each solved by Newton's method. */
enum { STEPS_AT_ONCE = 1 };

#define store_steps(over, first, end) 0
#define propagate_by_iteration(over, k, kept) 0
#endif

/* Propagates the vectors over steps first <= k < end. */
static int propagate_steps(propagation *over, long long first, long long end)
{
  int iterated, status = OK;
  over->guess = over->back ? 0 : over->guess;
  iterated = store_steps(over, first, end);
  for (long long done = 0; status == OK && done < end - first; done++) {
    const long long k = over->back ? end - 1 - done : first + done;
    if (over->errors) {
      memset(vectors_at(over, k + 1), 0, sizeof(real) * (size_t)(over->count * STEP_INPUTS));
      round_positions(over->errors, over->q + k * M, 1, vectors_at(over, k));
    }
    const int carried = iterated ? propagate_by_iteration(over, k, stored_of(over, k - first)) : 0;
    if (!iterated || carried < over->count)
      status = over->errors ? NOT_CONVERGED : vectors_by_newton(over, k, carried);
    else if (!all_finite(vectors_at(over, k + !over->back), over->count * STEP_INPUTS))
      status = NOT_FINITE;
    if (status == OK && over->errors) {
      real increments[2 * M];
      for (int i = 0; i < M; i++) {
        increments[i] = over->q[(k + 1) * M + i] - over->q[k * M + i];
        increments[M + i] = over->p[(k + 1) * M + i] - over->p[k * M + i];
      }
      round_positions(over->errors, over->q + k * M, -1, vectors_at(over, k + 1));
      receive_roundings(over->errors, k, increments, vectors_at(over, k + 1));
    }
    over->report->steps += status == OK;
  }
  return status;
}

/* Propagates over all steps in blocks. On failure report->t is the time of the failed step. */
static int propagate_blocks(propagation *over, long long steps)
{
  int status = OK;
  memset(over->report, 0, sizeof *over->report);
  for (long long done = 0; status == OK && done < steps; done += STEPS_AT_ONCE) {
    const long long left = steps - done, own = left < STEPS_AT_ONCE ? left : STEPS_AT_ONCE;
    const long long first = over->back ? left - own : done;
    status = propagate_steps(over, first, first + own);
  }
  return status;
}

/* Tangent or adjoint vectors over a sequence of steps, forward or backward. Requires: propagate_steps, which propagates
 * them over at most STEPS_AT_ONCE steps. */
int NAME(linearise)(long long steps, const real *t, const real *h, const real *q, const real *p,
    const real *parameters, const solver_options *options, int back, int count, real *vectors, real *q1, real *p1,
    solver_report *report, real *workspace)
{
  propagation over = {PROPAGATION_OF_ARGUMENTS, .q1 = q1, .p1 = p1, .back = back, .count = count, .vectors = vectors,
      .accepted = LEFT_TO_COME};
  return propagate_blocks(&over, steps);
}

#ifdef VECTORS_BY_ITERATION
/* Samples of rounding errors along the saved states of a run, until an iteration fails. The vectors after the last of
 * k steps are those of row k % 2. What is `left` of the change of a vector compounds over the steps. Their derivatives
 * are those along the curves of another method, with values at `points` abscissae in each step. */
int NAME(transport_roundings)(long long steps, const real *t, const real *h, const real *q, const real *p,
    const real *parameters, const solver_options *options, int points, const real *abscissae, const real *curves,
    int count, double left, double rounding, unsigned long long seed, real *vectors, long long stride, real *deviations,
    solver_report *report, real *workspace)
{
  lanes table[(points + 1) * GROUPS];
  const stored_curves stored = {points, curves, table};
  rounding_vectors all = {count, STEP_INPUTS, rounding, seed, stride, deviations};
  propagation over = {PROPAGATION_OF_ARGUMENTS, .accepted = left * left, .count = count, .errors = &all,
      .curves = &stored, .vectors = vectors};
  tabulate_points(points, abscissae, table);
  return propagate_blocks(&over, steps);
}
#endif
