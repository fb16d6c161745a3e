/* Acceptance of adaptive steps of systems with few coordinates: comparison with half steps and update of the state.
 * Requires: trials.h, halves.h. Include before advance_to.h. */

#define ALLOWED_TO_HALVES 100 /* admissible difference of the half steps, relative to the admissible error estimate */
#define SPURIOUS REAL(1e-8) /* relative to the state: spurious solutions of the equations differ by more */

#define SMALL_PART REAL(0.1)
#define DOUBTED 16 /* steps that are compared after one that was shortened by a comparison */

/* Returns 1 if the momenta change by a small part of the largest one, as they do where nonsmooth forces shorten a
 * step. */
static SELDOM int changes_little(const trial *now)
{
  real change = 0, size = 0;
  for (int i = 0; i < M; i++) {
    change = larger(change, MATH(fabs)(now->dp[i]));
    size = larger(size, MATH(fabs)(now->at.p[i]));
  }
  return change < SMALL_PART * size;
}

/* Returns 1 if the momenta of a step are compared, too: after a step that was wrong, and where the step size fell by a
 * factor of two or more although the momenta change little. Near a singular time or a nonsmooth force the coefficients
 * of the curve do not decay and do not show its error; steps are then so short that the error is in the momenta. Not
 * for Newton's method, whose steps may leave vibrations of stiff systems unresolved. */
static inline int is_doubted(const run_memory *run, const trial *now)
{
  return SHORT_STEPS_FAIL && (run->doubted > 0 || (now->change <= -OCTAVE && changes_little(now)));
}

/* Compares a step with its half steps and shortens it while the difference is far above its error estimate. */
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
    if (!shorten(run, now, MOST_DOWN))
      return STATUS(VANISHED);
    run->error_before = now->limits.most;
    status = find_step(run, now, options, report);
    if (status != OK)
      return status;
  }
}

/* Compares the first step, one of COMPARED later, and those in doubt. */
static inline int confirm_step(run_memory *run, trial *now, const solver_options *options, solver_report *report)
{
  return run->step % COMPARED == 0 || is_doubted(run, now) ? compare_step(run, now, options, report) : OK;
}

/* Adds the increments of the accepted step to the state. */
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
