#include "../core/step.h"
#include "arrays.h"

/* Splitting step of an array system, with the equations of splitting.h. Forces are added to the increments of the
 * momenta term by term, without an array of their own: a pass less over memory. Requires: arrays.h, add_forces, LEAPS,
 * CHUNK, the tables. */

/* Workspace: positions of the next kick, forces at the end of a step, increments of positions and momenta. */
typedef struct {
  long long n; /* coordinates */
  double *X, *F, *dq, *dp;
} work_arrays;

static work_arrays bind_work_arrays(const run_memory *run, long long n)
{
  double *work = run->work;
  const work_arrays of = {n, work, work + n, work + 2 * n, work + 3 * n};
  return of;
}

/* Adds a drift to the increments; X are the positions afterwards. */
static void drift_by(double by, const double *restrict inverse_mass, const double *restrict p,
    const double *restrict dp, const double *restrict q, double *restrict dq, double *restrict X, section own)
{
  for (long long i = own.first; i < own.end; i++) {
    dq[i] += by * (inverse_mass[i] * (p[i] + dp[i]));
    X[i] = q[i] + dq[i];
  }
}

static int all_sums_finite(const run_memory *run, const work_arrays *work)
{
  sums all;
  begin_sums(&all, run, work->n);
  while (next_block(&all)) {
    int faults = 0;
    for (long long i = all.here.first; i < all.here.end; i++) {
      faults |= !is_finite(run->q[i] + work->dq[i]);
      faults |= !is_finite(run->p[i] + work->dp[i]);
    }
    add_block(&all, faults, 0.0);
  }
  wait_at_barrier(run);
  return sum_of(&all, 0) == 0.0;
}

/* Returns 1 if the last kick is at the end of a step: its forces are those of the first kick of the next step. */
static int ends_with_a_kick(void)
{
  return KICK[0] != 0.0 && KICK[LEAPS - 1] != 0.0 && DRIFT[LEAPS - 1] == 0.0;
}

/* Kicks the momenta of this thread; stores forces that the next step can reuse. */
static void kick_by(const run_memory *run, const problem *arrays, const work_arrays *work, int k, section own)
{
  const double by = run->h * KICK[k], t = run->t + KICK_ABSCISSA[k] * run->h;
  const long long size = own.end - own.first;
  if (k == 0 && run->guess)
    add_to(work->dp + own.first, work->F + own.first, by, size);
  else if (k == LEAPS - 1 && ends_with_a_kick()) {
    memset(work->F + own.first, 0, sizeof(double) * (size_t)size);
    add_forces(run, arrays, work->X, t, 1.0, work->F);
    add_to(work->dp + own.first, work->F + own.first, by, size);
  } else
    add_forces(run, arrays, work->X, t, by, work->dp);
}

/* Performs a step. The increments start with the compensation terms of the state. */
static int perform_step(run_memory *run, const problem *arrays, const work_arrays *work, const solver_options *options,
    solver_report *report)
{
  const section own = mine(run, work->n);
  const size_t size = (size_t)(own.end - own.first);
  (void)options;
  memcpy(work->dq + own.first, run->carry_q + own.first, sizeof(double) * size);
  memcpy(work->dp + own.first, run->carry_p + own.first, sizeof(double) * size);
  drift_by(0.0, run->inverse_mass, run->p, work->dp, run->q, work->dq, work->X, own);
  for (int k = 0; k < LEAPS; k++) {
    if (KICK[k] != 0.0)
      kick_by(run, arrays, work, k, own);
    if (DRIFT[k] != 0.0)
      drift_by(run->h * DRIFT[k], run->inverse_mass, run->p, work->dp, run->q, work->dq, work->X, own);
  }
  report->iterations++;
  run->error = NAN;
  if (!all_sums_finite(run, work)) {
    run->guess = 0; /* the stored forces belong to no accepted state */
    return NOT_FINITE;
  }
  add_all(run->q + own.first, work->dq + own.first, run->carry_q + own.first, (long long)size);
  add_all(run->p + own.first, work->dp + own.first, run->carry_p + own.first, (long long)size);
  run->guess = ends_with_a_kick();
  return OK;
}
