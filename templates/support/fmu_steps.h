/* From one communication point to the next. Before it: fmu.h, and PROJECT, which puts a state on constraints. */

#define NO_STEP 1e-9 /* of a step: what is left that is not worth one, as where inputs are tables */
#define TIME_ROUNDING (4 * DBL_EPSILON) /* of a time, what sums of steps may be off */
#define MISTAKEN 1e3 /* so many times what a time may be off: a step from elsewhere, not rounding */
#define FAR_OFF 1e-2 /* the constraints, relative to the positions: an initial state that is not meant */

/* In the place of PROJECT where there is nothing to project on. */
static inline int no_constraints(double t, const double *q0, const double *p0, const double *parameters, double *q1,
    double *p1, double *workspace)
{
  (void)t, (void)parameters, (void)workspace;
  memcpy(q1, q0, sizeof(double) * M);
  memcpy(p1, p0, sizeof(double) * M);
  return STATUS(OK);
}

/* The initial state put on the constraints; from then on momenta are what is known. */
static fmi3Status put_on_constraints(fmu *one)
{
  double *x = one->now.values, q[M], p[M], size = 0, moved = 0;
  const int status = PROJECT(x[TIME], x + POSITIONS, x + MOMENTA, x + FIRST_PARAMETER, q, p, one->workspace);
  if (status != STATUS(OK))
    return failed(one, fmi3Error, "no state near the initial one meets the constraints: %s", reason(status));
  for (int i = 0; i < M; i++) {
    size = fmax(size, fabs(q[i]));
    moved = fmax(moved, fabs(q[i] - x[POSITIONS + i]));
  }
  if (moved > FAR_OFF * size)
    return failed(one, fmi3Error, "the initial positions are off the constraints by %.1e of their size", moved / size);
  memcpy(x + POSITIONS, q, sizeof q);
  memcpy(x + MOMENTA, p, sizeof p);
  return fmi3OK;
}

FMI_EXPORT fmi3Status FMI(ExitInitializationMode)(fmi3Instance instance)
{
  fmu *one = instance;
  double *x = one->now.values;
  fmi3Status status;
  if (one->now.mode != INITIALIZATION_MODE)
    return not_now(one, "fmi3ExitInitializationMode");
  status = follow(one, fmi3Error);
  if (status == fmi3OK)
    status = put_on_constraints(one);
  if (status != fmi3OK)
    return status;
  NAME(start)(&one->now.run, x[TIME], STEP, x + POSITIONS, x + MOMENTA);
  one->now.behind = CONSTRAINTS > 0;
  one->now.mode = STEP_MODE;
  return fmi3OK;
}

/* How exactly a time is known, and has to be met. */
static double slack_at(double t)
{
  return NO_STEP * STEP + TIME_ROUNDING * fabs(t);
}

/* The number of steps that lead to the next communication point, and their length: STEP where that fits, that of the
 * steps before where that does, else an equal part of the way. */
static long long plan(NAME(run) * run, double end)
{
  const double left = end - run->t, slack = slack_at(end), count = fmax(1, ceil((left - slack) / STEP));
  double length = left / count;
  if (fabs(count * STEP - left) <= slack)
    length = STEP;
  else if (fabs(count * run->h - left) <= slack)
    length = run->h;
  run->guess = run->h == length ? run->guess : 0;
  run->h = length;
  return (long long)count;
}

FMI_EXPORT fmi3Status FMI(DoStep)(fmi3Instance instance, fmi3Float64 point, fmi3Float64 size, fmi3Boolean no_return,
    fmi3Boolean *event, fmi3Boolean *terminate, fmi3Boolean *early, fmi3Float64 *last)
{
  fmu *one = instance;
  run_memory *run = &one->now.run;
  NAME(report)
  report;
  double *x = one->now.values, t, q[M], p[M];
  int status, iterations;
  (void)no_return;
  if (one->now.mode != STEP_MODE)
    return not_now(one, "fmi3DoStep");
  if (!(fabs(point - run->t) <= MISTAKEN * slack_at(point)))
    return failed(one, fmi3Error, "a step from t = %.17g, where this FMU is at %.17g", point, run->t);
  if (!(size > 0 && size / STEP < 1 / DBL_EPSILON))
    return failed(one, fmi3Error, "a communication step of %g: it is positive, and less than 2^52 steps", size);
  one->before = *run;
  status = NAME(advance)(run, plan(run, point + size), LLONG_MAX, x + FIRST_PARAMETER, NULL, &t, q, p, &iterations,
      &report, one->workspace);
  if (status != STATUS(OK)) {
    *run = one->before;
    *last = run->t;
    return failed(one, fmi3Discard, "the step at t = %g: %s", report.t, reason(status));
  }
  x[TIME] = *last = run->t;
  memcpy(x + POSITIONS, run->q, sizeof run->q);
  memcpy(x + MOMENTA, run->p, sizeof run->p);
  one->now.behind = true;
  *event = *terminate = *early = false;
  return fmi3OK;
}
