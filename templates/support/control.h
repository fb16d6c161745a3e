/* Steps that choose their own length, roots of 2 to the power of a rung. Before it: attempt of a solver, which tries a
 * step, and SHORT_STEPS_FAIL, whether rounding alone may make it fail; MANTISSA, and GROWTH, what a rung up multiplies
 * the error of a curve by. After it: advance_to.h. */
enum {
  OCTAVE = sizeof MANTISSA / sizeof *MANTISSA, /* rungs */
  MOST_UP = 4 * OCTAVE, /* rungs, while the first step is looked for */
  MOST_DOWN = 2 * OCTAVE /* after a step that failed */
};

#define USED_PART REAL(0.5) /* of the error allowed, what a longer step may be expected to use */
#define LITTLE REAL(0.5) /* of the error that lets a step be two rungs longer: less is not measured */
#define LAST_STEP REAL(1e-6) /* a step that ends so near the end, as a part of it, ends there */
#define FIRST_STEP REAL_EPSILON /* of the whole span: the first step tried */
#define ROUNDOFF_ERROR (REAL(0.03125) * REAL_EPSILON) /* of a step: a million add up to what rounding leaves */
#define LEAST_UNRESOLVED (REAL(65536.0) * REAL_EPSILON * REAL_EPSILON) /* of a curve: less is rounding */
#define ITERATION_PART REAL(0.00390625) /* of the error allowed to a step: that of its stage equations */

/* A rung up multiplies the error of a curve by GROWTH. A step is too long beyond `most`, and may be a rung longer below
 * `few`, two below `fewer`. */
typedef struct {
  real most, few, fewer;
  real decay; /* from a coefficient of a curve to the next, where its error is just allowed */
} error_limits;

static error_limits limits_of(real tolerance)
{
  const real most = larger(MATH(pow)(tolerance, 1 / ERROR_POWER), LEAST_UNRESOLVED);
  const error_limits limits = {most, most * USED_PART / GROWTH, most * USED_PART / (GROWTH * GROWTH),
      MATH(exp2)(MATH(log2)(most) / (OCTAVE * MATH(log2)(GROWTH) - 2))};
  return limits;
}

static real length_of(long long rung)
{
  const long long octave = rung >= 0 ? rung / OCTAVE : -((OCTAVE - 1 - rung) / OCTAVE);
  return MATH(ldexp)(MANTISSA[rung - octave * OCTAVE], (int)octave);
}

/* The longest rung that is not longer than h > 0. */
static long long rung_below(real h)
{
  int exponent;
  long long rung;
  MATH(frexp)(h, &exponent);
  for (rung = (long long)exponent * OCTAVE; length_of(rung) > h; rung--)
    ;
  return rung;
}

/* By how many rungs the next step is longer. The error is expected to go on growing as it did; where it fell, much of
 * that may have been luck. */
static int next_change(real error, real before, const error_limits *limits)
{
  const real expected = before > 0 && error > before ? error * smaller(error / before, GROWTH * GROWTH)
                                                     : larger(error, before / (GROWTH * GROWTH));
  if (expected > limits->most)
    return expected > limits->most * GROWTH ? -2 : -1;
  return expected < limits->fewer ? 2 : expected < limits->few;
}

/* What the trials of a step share. */
typedef struct {
  state at;
  step_data step;
  solver_data data;
  error_limits limits;
  real t_end, error, dq[2 * M], dp[2 * M]; /* increments, then their low parts */
  long long guess;
  int last; /* whether the step ends at t_end */
} trial;

/* One trial of the step that the run is at: increments, and what their curve leaves unresolved, if more than `least`;
 * infinity where there is none. */
HOT void try_step(run_memory *run, trial *now, real least, const solver_options *options, solver_report *report)
{
  const real rest = (now->t_end - now->at.t) - now->at.t_low, length = length_of(run->rung);
  now->last = length * (1 + LAST_STEP) >= MATH(fabs)(rest);
  report->t = now->step.t = now->at.t;
  if (now->last || MATH(fabs)(now->step.h) != length) {
    now->step.h = now->last ? rest : MATH(copysign)(length, rest);
    prepare(&now->step, &now->data);
  }
  now->error = attempt(run, &now->step, &now->data, now->last, &now->guess, now->dq, now->dp, now->limits.decay, least,
      options, report);
}

/* By how many rungs the first step may be longer at once. */
static int rungs_up(const trial *now)
{
  real error = now->error;
  int up = 0;
  if (error < now->limits.fewer)
    for (; up < MOST_UP && error * GROWTH <= now->limits.most; up++)
      error *= GROWTH;
  return up;
}

/* The first step: from one that is certainly too short by trial to one that is about right. The shortest may fail, and
 * of sweeps longer ones, too: where some velocities are zero, rounding leaves little of what they become. */
static void try_first_step(run_memory *run, trial *now, const solver_options *options, solver_report *report)
{
  const real span = MATH(fabs)(now->t_end - now->at.t);
  int found = 0, up = 1;
  run->rung = rung_below(run->h != 0 ? MATH(fabs)(run->h) : span * FIRST_STEP);
  try_step(run, now, 0, options, report);
  while (!now->last && up > 0) {
    const int failed = !(now->error < INFINITY);
    found = found || !failed;
    up = failed && (SHORT_STEPS_FAIL || !found) ? MOST_UP : rungs_up(now);
    run->rung += up;
    if (up > 0)
      try_step(run, now, 0, options, report);
  }
}

/* Shortens the step after a trial that failed, or whose error was too large; 0 if it is as good as nothing. */
static int shorten(run_memory *run, const trial *now)
{
  real error = now->error;
  int down = 0;
  for (; down < MOST_DOWN && !(error <= now->limits.most); down++)
    error /= GROWTH;
  run->rung -= down > 1 ? down : 2;
  run->guess = 0;
  run->rejected++;
  return length_of(run->rung) > VANISHING * (MATH(fabs)(now->at.t) + REAL_EPSILON * MATH(fabs)(now->t_end - now->at.t));
}

/* The step that the run is at, tried shorter and shorter until its error is allowed or it vanishes. */
HOT int find_step(run_memory *run, trial *now, const solver_options *options, solver_report *report)
{
  const real least = LITTLE * now->limits.fewer;
  if (run->error_before > 0)
    try_step(run, now, least, options, report);
  else
    try_first_step(run, now, options, report);
  while (!(now->error <= now->limits.most * GROWTH)) {
    if (!shorten(run, now))
      return STATUS(VANISHED);
    try_step(run, now, least, options, report);
  }
  now->error = larger(now->error, least);
  return OK;
}

/* Chooses the length of the next step. */
static inline void choose_length(run_memory *run, const trial *now)
{
  const int change = next_change(now->error, run->error_before, &now->limits);
  run->guess = now->guess;
  run->change_before = run->change;
  run->change = change;
  run->rung += change;
  run->error_before = now->error;
  for (int k = change; k > 0; k--)
    run->error_before *= GROWTH;
  for (int k = change; k < 0; k++)
    run->error_before /= GROWTH;
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

/* What steps are chosen by: the error allowed to each, which their equations are then solved for. */
static void begin_trials(run_memory *run, trial *now, real tolerance, solver_options *standard)
{
  now->limits = limits_of(tolerance > 0 ? tolerance : ROUNDOFF_ERROR);
  standard->tolerance = larger(REAL_EPSILON, ITERATION_PART * tolerance);
  if ((real)run->direction * (now->t_end - run->t) < 0)
    run->guess = 0;
}
