#ifndef SUPPORT_CONSTRAINT_PROJECTION_H
#define SUPPORT_CONSTRAINT_PROJECTION_H

#include "constrained_step.h"

/* Projection onto the constraints, their values, and their Lagrange multipliers. Requires: constrained_step.h,
 * array_run.h. */

#define REFINEMENTS 3
#define REFINED 1e-6 /* reduction of the residual per refinement */

/* Projects the positions onto g = 0: the nearest state in the metric of the masses, q0 + M^-1 G^T lambda with G
 * there. */
static int project_positions(const constrained_run *of)
{
  const constraint_system *held = &of->held;
  const work_arrays *work = of->work;
  const run_memory *run = of->run;
  progress now = before_iterations();
  memset(held->lambda, 0, sizeof(double) * (size_t)held->count);
  memcpy(work->Y, run->q, sizeof(double) * (size_t)of->n);
  for (int k = 0;; k++) {
    double moved = 0.0, size = 0.0;
    int status;
    evaluate_constraints(of->given, work->Y, run->t, held->g, held->rate, held->derivative);
    if (!assemble(held, run->inverse_mass))
      return SINGULAR;
    compute_constraint_forces(held, held->lambda, work->R, of->n);
    for (long long i = 0; i < of->n; i++)
      work->D[i] = (run->q[i] - work->Y[i]) + run->inverse_mass[i] * work->R[i];
    for (long long i = 0; i < of->n; i++)
      work->X[i] = fabs(run->q[i]) + fabs(work->Y[i]);
    find_right(held, held->g, work->D, 1.0);
    compute_rounding(held, held->derivative, work->X, 1.0);
    if (now.status)
      return end_of_iteration(&now, held, of->report);
    status = solve_constraint_system(held, NEAR_ENOUGH, of->report);
    if (status != OK)
      return status;
    add_to(held->lambda, held->change, 1.0, held->count);
    compute_constraint_forces(held, held->lambda, work->R, of->n);
    for (long long i = 0; i < of->n; i++) {
      const double to = run->q[i] + run->inverse_mass[i] * work->R[i], move = to - work->Y[i];
      moved += move * move;
      size += to * to;
      work->Y[i] = to;
    }
    take_change(&now, relative_change(moved, of->options->absolute ? 1.0 : size), of->options, k, of->report);
  }
}

int NAME(project)(run_memory *run, const problem *given, const solver_options *options, solver_report *report)
{
  const solver_options standard = NAME(default_options)();
  const work_arrays work = bind_work_arrays(run, NAME(coordinates)(given));
  const constrained_run of = constrained_run_of(run, given, &work, options ? options : &standard, report);
  double size = 0.0;
  int status;
  memset(report, 0, sizeof *report);
  report->t = run->t;
  run->guess = 0;
  status = project_positions(&of);
  if (status != OK)
    return status;
  memset(of.work->dp, 0, sizeof(double) * (size_t)of.n);
  for (long long i = 0; i < of.n; i++) {
    of.work->X[i] = fabs(run->inverse_mass[i] * run->p[i]);
    size += of.work->X[i] * of.work->X[i];
  }
  status = project_momenta(&of, 1.0, 1.0, size, NULL);
  if (status != OK)
    return status;
  memcpy(run->q, of.work->Y, sizeof(double) * (size_t)of.n);
  add_to(run->p, of.work->dp, 1.0, of.n);
  return OK;
}

void NAME(constraint_values)(run_memory *run, const problem *given, double *g, double *rate)
{
  const work_arrays work = bind_work_arrays(run, NAME(coordinates)(given));
  const constrained_run of = constrained_run_of(run, given, &work, NULL, NULL);
  evaluate_constraints(given, run->q, run->t, g, rate, of.held.next);
  for (long long k = 0; k < of.held.count; k++)
    for (int e = of.held.of.first[k]; e < of.held.of.first[k + 1]; e++) {
      const int i = of.held.of.place[e];
      rate[k] += of.held.next[e] * (run->inverse_mass[i] * run->p[i]);
    }
}

/* Multipliers from G M^-1 (F + G^T lambda) = -d^2 g / dt^2 at constant velocity. The predictor of the next step is not
 * changed. */
int NAME(multipliers)(run_memory *run, const problem *given, double *lambda)
{
  solver_report report = {0};
  const work_arrays work = bind_work_arrays(run, NAME(coordinates)(given));
  const constrained_run of = constrained_run_of(run, given, &work, NULL, &report);
  const constraint_system *held = &of.held;
  double *F = of.work->D, *pulled = of.work->Y;
  int status = run->guess ? OK : begin(&of);
  if (status != OK)
    return status;
  find_forces(&of, run->q, NULL, run->t, F);
  for (long long i = 0; i < of.n; i++)
    pulled[i] = run->inverse_mass[i] * run->p[i];
  compute_second_derivatives(given, run->q, pulled, run->t, held->g);
  memset(lambda, 0, sizeof(double) * (size_t)held->count);
  for (int round = 0; status == OK && round < REFINEMENTS; round++) {
    compute_constraint_forces(held, lambda, of.work->R, of.n);
    for (long long i = 0; i < of.n; i++)
      pulled[i] = run->inverse_mass[i] * (F[i] + of.work->R[i]);
    find_right(held, held->g, pulled, 1.0);
    for (long long i = 0; i < of.n; i++)
      pulled[i] = run->inverse_mass[i] * (fabs(F[i]) + fabs(of.work->R[i]));
    compute_rounding(held, held->derivative, pulled, 1.0);
    status = solve_constraint_system(held, REFINED, &report);
    add_to(lambda, held->change, 1.0, held->count);
  }
  return status;
}

#endif
