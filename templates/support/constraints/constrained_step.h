#include "../core/progress.h"
#include "constraint_matrix.h"

/* Constrained step: RATTLE substeps (H. C. Andersen, J. Comput. Phys. 52, 1983; Hairer, Lubich & Wanner, Geometric
 * Numerical Integration, sec. VII.1.4), composed with the coefficients PART. Requires: add_forces,
 * evaluate_constraints, constraint_matrix.h, progress.h, PARTS of a step, PART and their ends, PART_END. */

#ifdef FORCES_OF_VELOCITIES
#define VELOCITY_FORCES 1
#else
#define VELOCITY_FORCES 0
#endif
#define NEAR_ENOUGH 1e-3 /* relative residual to which the linear system of a correction is solved */

/* Workspace: magnitudes for rounding errors; forces; increments of positions and momenta; constraint forces; trial
 * increments, and the positions they lead to, with the velocities behind them if forces depend on these. */
typedef struct {
  long long n; /* coordinates */
  double *X, *F, *dq, *dp, *R, *D, *Y;
} work_arrays;

static work_arrays bind_work_arrays(const run_memory *run, long long n)
{
  double *work = run->work;
  return (work_arrays){n, work, work + n, work + 2 * n, work + 3 * n, work + 4 * n, work + 5 * n, work + 6 * n};
}

/* Data shared by the substeps. */
typedef struct {
  run_memory *run;
  work_arrays work;
  constraint_system held;
  long long n;
  const solver_options *options;
  solver_report *report;
} constrained_run;

static inline constrained_run constrained_run_of(run_memory *run, const solver_options *options, solver_report *report)
{
  const long long n = coordinates_of(&run->data);
  return (constrained_run){run, bind_work_arrays(run, n), constraint_arrays(run, n), n, options, report};
}

/* x = G^T lambda. */
static void compute_constraint_forces(const constraint_system *held, const double *lambda, double *x, long long n)
{
  memset(x, 0, sizeof(double) * (size_t)n);
  for (long long k = 0; k < held->count; k++)
    for (int e = held->of.first[k]; e < held->of.first[k + 1]; e++)
      x[held->of.place[e]] += held->derivative[e] * lambda[k];
}

/* Forces at positions X, and at the velocities of p + dp, of p if dp is NULL. */
static void find_forces(const constrained_run *of, const double *X, const double *dp, double t, double *F)
{
#ifdef FORCES_OF_VELOCITIES
  double *Y = of->work.Y;
  if (X != Y)
    memcpy(Y, X, sizeof(double) * (size_t)of->n);
  for (long long i = 0; i < of->n; i++)
    Y[of->n + i] = of->run->inverse_mass[i] * (of->run->p[i] + (dp ? dp[i] : 0.0));
  X = Y;
#endif
  memset(F, 0, sizeof(double) * (size_t)of->n);
  add_forces(of->run, &of->run->data, X, t, 1.0, F);
}

/* Computes forces, constraint derivatives and their matrix at the state. */
static int begin(const constrained_run *of)
{
  find_forces(of, of->run->q, NULL, of->run->t, of->work.F);
  evaluate_constraints(&of->run->data, of->run->q, of->run->t, of->held.g, of->held.rate, of->held.derivative);
  return assemble(&of->held, of->run->inverse_mass) ? OK : SINGULAR;
}

/* Computes the trial increments due to the constraint forces, the positions, and the magnitudes of their terms; returns
 * the squared size of the coordinates. */
static double trial_increments(const constrained_run *of, double h)
{
  const run_memory *run = of->run;
  const work_arrays *work = &of->work;
  double size = 0.0;
  for (long long i = 0; i < of->n; i++) {
    const double p = run->p[i] + work->dp[i], pushed = h / 2 * work->R[i];
    const double drift = h * (run->inverse_mass[i] * (p + pushed));
    work->D[i] = work->dq[i] + drift;
    work->Y[i] = run->q[i] + work->D[i];
    work->X[i] = fabs(run->q[i]) + fabs(h * run->inverse_mass[i]) * (fabs(p) + fabs(pushed));
    size += work->X[i] * work->X[i];
  }
  return size;
}

/* x += by y; returns the squared size of M^-1 y. */
static double push(double *x, const double *y, double by, const double *inverse_mass, long long n)
{
  double size = 0.0;
  for (long long i = 0; i < n; i++) {
    const double moved = inverse_mass[i] * y[i];
    x[i] += by * y[i];
    size += moved * moved;
  }
  return size;
}

/* Status of a finished iteration. Constraints that are violated at converged positions contradict each other:
 * SINGULAR. */
static int end_of_iteration(const progress *now, const constraint_system *held, solver_report *report)
{
  const double left = product_of(held->right, held->right, held->count);
  const double rounding = product_of(held->rounding, held->rounding, held->count);
  TRY(outcome(now, report));
  return left <= ROUNDING_MULTIPLE * ROUNDING_MULTIPLE * rounding ? OK : SINGULAR;
}

/* Solves for the multipliers at the start that give g = 0 at the end; leaves trial increments and the derivatives
 * there. */
static int solve_positions(const constrained_run *of, double h, double t, double *size)
{
  const constraint_system *held = &of->held;
  const work_arrays *work = &of->work;
  progress now = before_iterations();
  compute_constraint_forces(held, held->lambda, work->R, of->n);
  for (int iteration = 0;; iteration++) {
    double moved;
    *size = trial_increments(of, h);
    evaluate_constraints(&of->run->data, work->Y, t, held->g, held->rate, held->next);
    for (long long k = 0; k < held->count; k++)
      held->right[k] = -2.0 / (h * h) * held->g[k];
    if (now.status || !held->is_exact)
      compute_rounding(held, held->next, work->X, 2.0 / (h * h));
    if (now.status)
      return end_of_iteration(&now, held, of->report);
    TRY(solve_constraint_system(held, NEAR_ENOUGH, of->report));
    add_to(held->lambda, held->change, 1.0, held->count);
    compute_constraint_forces(held, held->change, work->F, of->n);
    moved = h * h / 2 * (h * h / 2) * push(work->R, work->F, 1.0, of->run->inverse_mass, of->n);
    take_change(&now, relative_change(moved, of->options->absolute ? 1.0 : *size), of->options, iteration, of->report);
  }
}

/* right = -scale (rate + G x). */
static void find_right(const constraint_system *held, const double *rate, const double *x, double scale)
{
  for (long long k = 0; k < held->count; k++) {
    double sum = rate[k];
    for (int e = held->of.first[k]; e < held->of.first[k + 1]; e++)
      sum += held->derivative[e] * x[held->of.place[e]];
    held->right[k] = -scale * sum;
  }
}

/* Replaces the forces of weight `by` in p + dp by those at its velocities; returns the squared size of M^-1 times their
 * change. */
static double update_forces(const constrained_run *of, double by, double t)
{
  const work_arrays *work = &of->work;
  find_forces(of, work->Y, work->dp, t, work->R);
  for (long long i = 0; i < of->n; i++) {
    work->R[i] -= work->F[i];
    work->F[i] += work->R[i];
  }
  return push(work->dp, work->R, by, of->run->inverse_mass, of->n);
}

/* Projects the momenta onto G M^-1 p + g_t = 0 by constraint forces of weight `by`; the change of the velocities times
 * `unit` is compared with `size`. X contains the magnitudes of their terms. Forces at the time t, if not NULL, are
 * those at the velocities that result. */
static int project_momenta(const constrained_run *of, double by, double unit, double size, const double *t)
{
  const constraint_system *held = &of->held;
  const run_memory *run = of->run;
  progress now = before_iterations();
  for (int k = 0;; k++) {
    double moved = t && VELOCITY_FORCES ? update_forces(of, by, *t) : 0.0;
    for (long long i = 0; i < of->n; i++)
      of->work.D[i] = run->inverse_mass[i] * (run->p[i] + of->work.dp[i]);
    find_right(held, held->rate, of->work.D, 1.0 / by);
    if (!held->is_exact)
      compute_rounding(held, held->derivative, of->work.X, 1.0 / by);
    if (now.status)
      return outcome(&now, of->report);
    TRY(solve_constraint_system(held, NEAR_ENOUGH, of->report));
    compute_constraint_forces(held, held->change, of->work.R, of->n);
    moved += push(of->work.dp, of->work.R, by, run->inverse_mass, of->n);
    if (t && held->is_exact && !VELOCITY_FORCES) /* a linear system */
      return OK;
    moved *= unit * by * (unit * by);
    take_change(&now, relative_change(moved, of->options->absolute ? 1.0 : size), of->options, k, of->report);
  }
}

/* Performs one substep of size h that ends at t. */
static int constrained_substep(const constrained_run *of, double h, double t)
{
  const work_arrays *work = &of->work;
  const constraint_system *held = &of->held;
  const run_memory *run = of->run;
  double size;
  add_to(work->dp, work->F, h / 2, of->n);
  TRY(solve_positions(of, h, t, &size));
  add_to(work->dp, work->R, h / 2, of->n);
  memcpy(work->dq, work->D, sizeof(double) * (size_t)of->n);
  memcpy(held->derivative, held->next, sizeof(double) * (size_t)held->entries);
  TRY(assemble(held, run->inverse_mass) ? OK : SINGULAR);
  find_forces(of, work->Y, work->dp, t, work->F);
  compute_constraint_forces(held, held->lambda, work->R, of->n);
  for (long long i = 0; i < of->n; i++) {
    work->dp[i] += h / 2 * (work->F[i] + work->R[i]);
    work->X[i] = run->inverse_mass[i] *
        (fabs(run->p[i] + work->dp[i]) + fabs(h / 2) * (fabs(work->F[i]) + fabs(work->R[i])));
  }
  return project_momenta(of, h / 2, h, size, &t);
}

/* Performs a step. The increments start with the compensation terms of the state; a failed step leaves the state
 * unchanged and discards the predictor. */
static int perform_step(run_memory *run, const problem *arrays, const work_arrays *work, const solver_options *options,
    solver_report *report)
{
  const constrained_run of = constrained_run_of(run, options, report);
  const long long n = work->n;
  const int has_begun = run->guess != 0;
  run->error = NAN;
  run->guess = 0;
  if (!has_begun) {
    memset(of.held.lambda, 0, sizeof(double) * (size_t)of.held.count);
    TRY(begin(&of));
  }
  memcpy(of.work.dq, run->carry_q, sizeof(double) * (size_t)n);
  memcpy(of.work.dp, run->carry_p, sizeof(double) * (size_t)n);
  for (int k = 0; k < PARTS; k++)
    TRY(constrained_substep(&of, run->h * PART[k], run->t + run->h * PART_END[k]));
  for (long long i = 0; i < n; i++) {
    run->carry_q[i] = of.work.dq[i], run->carry_p[i] = of.work.dp[i];
    add_increment(&run->q[i], &run->carry_q[i]);
    add_increment(&run->p[i], &run->carry_p[i]);
  }
  run->guess = 1;
  return OK;
}
