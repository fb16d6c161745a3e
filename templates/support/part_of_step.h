/* Part of a step in tau that ends at a given time: x with duration(x h) = end - t, by Newton's method safeguarded by
 * bisection. Returns the status of a failed step, or NOT_CONVERGED. Requires: run.h, clock.h. */

#define MOST_TRIALS 60 /* bisection alone takes as many as a number has bits: 53 */
#define SMALLEST_MISS (4 * REAL_EPSILON) /* relative to the times */

int NAME(part_of_step)(real t, real h, real end, const real *q0, const real *p0, const real *parameters,
    const solver_options *options, real *q1, real *p1, real *part, solver_report *report, real *workspace)
{
  const real least = SMALLEST_MISS * larger(MATH(fabs)(t), MATH(fabs)(end));
  real low = 0, high = 1, rate, x;
  int status = NAME(rates)(1, q0, p0, parameters, &rate);
  if (status != OK)
    return status;
  x = (end - t) / (rate * h);
  for (int k = 0; k < MOST_TRIALS; k++) {
    real miss;
    x = x > low && x <= high ? x : (low + high) / 2;
    status = NAME(step)(t, x * h, q0, p0, parameters, options, q1, p1, report, workspace);
    if (status == OK)
      status = NAME(rates)(1, q1, p1, parameters, &rate);
    if (status != OK)
      return status;
    miss = (end - t) - report->duration;
    *part = x;
    if (MATH(fabs)(miss) <= least || high - low <= 2 * REAL_EPSILON)
      return OK;
    if (miss / h > 0)
      low = x;
    else
      high = x;
    x += miss / (rate * h);
  }
  return NOT_CONVERGED;
}
