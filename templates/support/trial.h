/* Trial of an adaptive step of a system with few coordinates. Requires: rungs.h; attempt of a solver, which tries a
 * step. */

/* Data shared by the trials of a step. */
typedef struct {
  state at;
  step_data step;
  solver_data data;
  error_limits limits;
  real t_end, error, dq[2 * M], dp[2 * M]; /* increments, then their low words */
  long long guess, rung; /* level of the step size */
  long long change; /* of the level, from the previous step to this */
  real length; /* step size; 0 before the first trial */
  int last; /* 1 if the step ends at t_end */
} trial;

/* Performs one trial of the next step: its increments and the error estimate of the curve if it exceeds `least`,
 * infinite if the step failed. */
HOT void try_step(run_memory *run, trial *now, real least, const solver_options *options, solver_report *report)
{
  const real rest = (now->t_end - now->at.t) - now->at.t_low;
  real h;
  if (now->length == 0 || now->rung != run->rung) {
    now->rung = run->rung;
    now->length = length_of(run->rung);
  }
  h = next_length(now->length, rest, &now->last);
  report->t = now->step.t = now->at.t;
  if (now->last || now->step.h != h) {
    now->step.h = h;
    prepare(&now->step, &now->data);
  }
  now->error = attempt(run, &now->step, &now->data, now->last, &now->guess, now->dq, now->dp, now->limits.decay, least,
      options, report);
}
