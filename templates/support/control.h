/* What makes the step that was found the state of few coordinates. Before it: trials.h, halves.h. After it:
 * advance_to.h. */

#define ALLOWED_TO_HALVES 100 /* times the error allowed to a step, what its halves may differ from it by */
#define SPURIOUS REAL(1e-8) /* of the state: by less than that other solutions of the equations differ not */

#define SMALL_PART REAL(0.1)
#define DOUBTED 16 /* steps that are compared after one that was shortened because of it */

/* Whether momenta change by a small part of the largest: so they do where forces that are not smooth shorten a step. */
static SELDOM int changes_little(const trial *now)
{
  real change = 0, size = 0;
  for (int i = 0; i < M; i++) {
    change = larger(change, MATH(fabs)(now->dp[i]));
    size = larger(size, MATH(fabs)(now->at.p[i]));
  }
  return change < SMALL_PART * size;
}

/* Whether a step is compared in momenta, too: where its size fell by an octave or more although little changes, and
 * after a step that was wrong. Where forces are not smooth, as at a singular time, the coefficients of a curve do not
 * decay, so that they do not show its error; and steps are so short that momenta have most of it. Not by Newton's
 * iteration, whose steps may leave vibrations of stiff systems unresolved. */
static inline int is_doubted(const run_memory *run, const trial *now)
{
  return SHORT_STEPS_FAIL && (run->doubted > 0 || (now->change <= -OCTAVE && changes_little(now)));
}

/* Compares a step with its halves, and shortens it while it is wrong by far more than its curve estimates. */
static SELDOM int compare_step(run_memory *run, trial *now, const solver_options *options, solver_report *report)
{
  const int doubted = is_doubted(run, now);
  const real allowed = larger(
      ALLOWED_TO_HALVES * MATH(pow)(now->limits.most, ERROR_POWER), doubted ? ROUNDOFF_LEVEL : SPURIOUS);
  for (;;) {
    real apart;
    int status = compare_with_halves(&now->step, now->dq, doubted ? now->dp : NULL, options, &apart);
    if (status > STATUS(STRAYED))
      return status;
    if (status == OK && apart <= allowed) {
      apart = MATH(pow)(apart, 1 / ERROR_POWER);
      if (apart > run->error) {
        run->error = apart;
        run->error_t = now->at.t;
      }
      run->doubted -= run->doubted > 0;
      return OK;
    }
    run->doubted = DOUBTED;
    now->error = INFINITY;
    if (!shorten(run, now))
      return STATUS(VANISHED);
    run->error_before = now->limits.most;
    status = find_step(run, now, options, report);
    if (status != OK)
      return status;
  }
}

/* Compares the first step, later few, and those in doubt. */
static inline int confirm_step(run_memory *run, trial *now, const solver_options *options, solver_report *report)
{
  return run->step % COMPARED == 0 || is_doubted(run, now) ? compare_step(run, now, options, report) : OK;
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
