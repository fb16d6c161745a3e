#include "constrained_step.h"

/* Projection onto the constraints. */

/* Projects the positions onto g = 0: the nearest state in the metric of the masses, q0 + M^-1 G^T lambda with G
 * there. */
static int project_positions(const constrained_run *of)
{
  const constraint_system *held = &of->held;
  const work_arrays *work = &of->work;
  const run_memory *run = of->run;
  progress now = before_iterations();
  memset(held->lambda, 0, sizeof(double) * (size_t)held->count);
  memcpy(work->Y, run->q, sizeof(double) * (size_t)of->n);
  for (int k = 0;; k++) {
    double moved = 0.0, size = 0.0;
    evaluate_constraints(&run->data, work->Y, run->t, held->g, held->rate, held->derivative);
    TRY(assemble(held, run->inverse_mass) ? OK : SINGULAR);
    compute_constraint_forces(held, held->lambda, work->R, of->n);
    for (long long i = 0; i < of->n; i++)
      work->D[i] = (run->q[i] - work->Y[i]) + run->inverse_mass[i] * work->R[i];
    for (long long i = 0; i < of->n; i++)
      work->X[i] = fabs(run->q[i]) + fabs(work->Y[i]);
    find_right(held, held->g, work->D, 1.0);
    compute_rounding(held, held->derivative, work->X, 1.0);
    if (now.status)
      return end_of_iteration(&now, held, of->report);
    TRY(solve_constraint_system(held, NEAR_ENOUGH, of->report));
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

/* Projects the state of a run, or only its momenta. */
static int project_run(run_memory *run, solver_report *report, int positions)
{
  const constrained_run of = constrained_run_of(run, &STANDARD_OPTIONS, report);
  double size = 0.0;
  run->guess = 0;
  TRY(project_positions(&of));
  memset(of.work.dp, 0, sizeof(double) * (size_t)of.n);
  for (long long i = 0; i < of.n; i++) {
    of.work.X[i] = fabs(run->inverse_mass[i] * run->p[i]);
    size += of.work.X[i] * of.work.X[i];
  }
  TRY(project_momenta(&of, 1.0, 1.0, size, NULL));
  if (positions)
    memcpy(run->q, of.work.Y, sizeof(double) * (size_t)of.n);
  add_to(run->p, of.work.dp, 1.0, of.n);
  return OK;
}
