#include "../newton/newton_from_line.h"
#include "linearise.h"

#ifdef UNKNOWNS_OF_POINTS
/* Actions of steps that are solved by fixed-point iteration. The unknowns z follow from the values at the points. The
 * action is stationary in z, so that their rounding errors enter squared. Requires: UNKNOWN_OF_POINTS. */

/* Steps first <= k < end; returns 0 if the iteration fails for one of them. */
static int actions_by_iteration(propagation *over, long long first, long long end, real *z, real *action)
{
  const real nothing[M] = {0};
  over->guess = first == 0 ? 0 : over->guess;
  if (!store_steps(over, first, end))
    return 0;
  for (long long k = first; k < end; k++) {
    const step_data step = step_of(over, k, nothing);
    const double *stored = stored_of(over, k - first);
    real totals[SUMS];
    for (int i = 0; i < M; i++)
      for (int b = 0; b < B; b++) {
        z[i * B + b] = 0;
        for (int n = 0; n < UNKNOWN_POINTS; n++)
          z[i * B + b] += UNKNOWN_OF_POINTS[b][n] * stored[(n / LANES * M + i) * LANES + n % LANES];
        z[i * B + b] /= UNKNOWNS_OF_POINTS(step.h);
      }
    sums_along(&step, z, totals);
    action[k] = totals[SUMS - 1];
  }
  return all_finite(action + first, (int)(end - first));
}
#endif

/* Actions of steps from given states: h sum_n w_n L along the curve of each step, without forces and constraints.
 * Requires: sums_along. */

int NAME(actions)(long long steps, const real *t, const real *h, const real *q, const real *p, const real *parameters,
    long long stride, const solver_options *options, real *q1, real *p1, real *action, solver_report *report,
    real *workspace)
{
  const real carry[M] = {0};
  newton_data *data = newton_in(workspace + SCRATCH);
  memset(report, 0, sizeof *report);
#ifdef UNKNOWNS_OF_POINTS
  propagation over = {PROPAGATION_OF_ARGUMENTS, .q1 = q1, .p1 = p1};
#endif
  for (long long k = 0; k < steps; k++) {
#ifdef UNKNOWNS_OF_POINTS
    const long long end = k + STEPS_AT_ONCE < steps ? k + STEPS_AT_ONCE : steps;
    if (k % STEPS_AT_ONCE == 0 && stride == 0 && actions_by_iteration(&over, k, end, data->z, action)) {
      report->steps = end;
      k = end - 1;
      continue;
    }
    over.guess = 0;
#endif
    const real *own = parameters + k * stride;
    const step_data step = step_from(t[k], h[k], q + k * M, p + k * M, carry, carry, own, workspace);
    real dq[M], dp[2 * M] = {0}, totals[SUMS];
    int keep = 0;
    report->t = t[k];
    TRY(newton_from_line(&step, data, dp, &keep, options ? options : &STANDARD_OPTIONS, report));
    gather(END_POSITION, 1, step.h, data->z, M, dq, 0, 1);
    for (int i = 0; i < M; i++) {
      q1[k * M + i] = step.q0[i] + dq[i];
      p1[k * M + i] = step.p0[i] + (dp[i] + dp[M + i]);
    }
    sums_along(&step, data->z, totals);
    action[k] = totals[SUMS - 1];
    TRY(all_finite(action + k, 1) && all_finite(q1 + k * M, M) && all_finite(p1 + k * M, M) ? OK : NOT_FINITE);
    report->steps++;
  }
  return OK;
}
