/* Integration from one communication point to the next. Requires: fmu.h, and PROJECT, the projection onto
 * constraints. */

#define NO_STEP 1e-9 /* relative to a step: remaining time that needs no step, e.g. with tabulated inputs */
#define TIME_ROUNDING (4 * DBL_EPSILON) /* relative to a time: error of a sum of steps */
#define MISTAKEN 1e3 /* relative to the slack of a time: a larger difference is a wrong start time, not rounding */
#define FAR_OFF 1e-2 /* violation of the constraints, relative to the positions, that is an error of the initial
                      * state */

/* PROJECT of a system without constraints. */
static inline int no_constraints(double t, const double *q0, const double *p0, const double *parameters, double *q1,
    double *p1, double *workspace)
{
  (void)t, (void)parameters, (void)workspace;
  memcpy(q1, q0, sizeof(double) * M);
  memcpy(p1, p0, sizeof(double) * M);
  return STATUS(OK);
}

/* Projects the initial state onto the constraints; from then on the momenta are the independent values. */
static fmi3Status put_on_constraints(fmu *one)
{
  double *x = one->now.values, q[M], p[M], size = 0, moved = 0;
  const int status = PROJECT(x[TIME], x + POSITIONS, x + MOMENTA, x + FIRST_PARAMETER, q, p, one->workspace);
  if (status != STATUS(OK))
    return failed(one, fmi3Error, "projecting the initial state onto the constraints failed: %s", reason(status));
  for (int i = 0; i < M; i++) {
    size = fmax(size, fabs(q[i]));
    moved = fmax(moved, fabs(q[i] - x[POSITIONS + i]));
  }
  if (moved > FAR_OFF * size)
    return failed(one, fmi3Error, "the initial positions violate the constraints by %.1e (relative)", moved / size);
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

/* Admissible error of a communication point. */
static double slack_at(double t)
{
  return NO_STEP * STEP + TIME_ROUNDING * fabs(t);
}

/* Number of steps to the next communication point, and their size: STEP if it fits, else that of the previous steps if
 * it fits, else an equal part of the interval. */
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
    return failed(one, fmi3Error, "the communication point is t = %.17g, but the FMU is at t = %.17g", point, run->t);
  if (!(size > 0 && size / STEP < 1 / DBL_EPSILON))
    return failed(one, fmi3Error, "the communication step size %g must be positive, and less than 2^52 steps", size);
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
