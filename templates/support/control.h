/* What makes the step that was found the state of few coordinates. Before it: trials.h, halves.h. After it:
 * advance_to.h. */

#define ALLOWED_TO_HALVES 100 /* times the error allowed to a step, what its halves may differ from it by */
#define SPURIOUS REAL(1e-8) /* of the state: by less than that other solutions of the equations differ not */

/* Compares the first step, and later few, with their halves, and shortens it while it is wrong by far more than its
 * curve tells. */
static SELDOM int compare_step(run_memory *run, trial *now, const solver_options *options, solver_report *report)
{
  const real allowed = larger(ALLOWED_TO_HALVES * MATH(pow)(now->limits.most, ERROR_POWER), SPURIOUS);
  for (;;) {
    real apart;
    int status = compare_with_halves(&now->step, now->dq, options, &apart);
    if (status > STATUS(STRAYED))
      return status;
    if (status == OK && apart <= allowed) {
      apart = MATH(pow)(apart, 1 / ERROR_POWER);
      if (apart > run->error) {
        run->error = apart;
        run->error_t = now->at.t;
      }
      return OK;
    }
    now->error = INFINITY;
    if (!shorten(run, now))
      return STATUS(VANISHED);
    run->error_before = now->limits.most;
    status = find_step(run, now, options, report);
    if (status != OK)
      return status;
  }
}

static inline int confirm_step(run_memory *run, trial *now, const solver_options *options, solver_report *report)
{
  return run->step % COMPARED == 0 ? compare_step(run, now, options, report) : OK;
}

/* Makes the step that was found the state. */
static inline void take_step(run_memory *run, trial *now)
{
  add_compensated(now->at.q, now->at.carry_q, now->dq);
  add_compensated(now->at.p, now->at.carry_p, now->dp);
  if (now->error > run->error) {
    run->error = now->error;
    run->error_t = now->at.t;
  }
  if (now->last) {
    now->at.t = now->t_end;
    now->at.t_low = 0;
    run->guess = 0;
  } else {
    add_to_time(&now->at.t, &now->at.t_low, now->step.h);
    choose_length(run, now);
  }
  run->step++;
}
