/* A trial of a step of few coordinates. Before it: rungs.h; attempt of a solver, which tries a step. */

/* What the trials of a step share. */
typedef struct {
  state at;
  step_data step;
  solver_data data;
  error_limits limits;
  real t_end, error, dq[2 * M], dp[2 * M]; /* increments, then their low parts */
  long long guess, rung; /* of the length */
  long long change; /* of rungs, from the step before to this */
  real length; /* 0 before the first trial */
  int last; /* whether the step ends at t_end */
} trial;

/* One trial of the step that the run is at: increments, and what their curve leaves unresolved, if more than `least`;
 * infinity where there is none. */
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
