#include "newton.h"

/* Newton's method without previous steps. */

/* Initial guess: q moves on a straight line with its initial velocity. */
static int line_from(const step_data *step, newton_data *data)
{
  real v[M];
  TRY(find_velocity(step->t, step->q0, step->p0, step->parameters, v, step->scratch));
  start_on_line(v, step->p0, data->z);
  return OK;
}

/* Stages that solve the equations with a step size near 0 belong to a branch, on which those of the step lie. Newton's
 * method from far away may converge to another root, a spurious solution: so may every method, and steps of one stage
 * have no error estimate that shows it. Roots that take few iterations are near the initial guess. Others are computed
 * again by continuation in the step size (Deuflhard, Newton Methods for Nonlinear Problems, sec. 5.1): from the stages
 * at one size to those at a larger one, in few iterations each. */
/* Iterations to a root near the initial guess: with frozen factors multipliers converge after positions. */
#define NEARBY_ITERATIONS (SITES > M ? 12 : 8)
#define CONTINUED_ITERATIONS 12 /* from the stages at a smaller size: with frozen factors convergence is linear */
#define LEAST_ADVANCE REAL(0.00390625) /* of the step size: the branch ends, or turns back */

/* Follows the branch from the stages at the line to those at step->h, with the results of newton. Returns
 * SPURIOUS_SOLUTION if there is none that far. */
static SELDOM int follow_branch(const step_data *step, newton_data *data, real *dp, int *keep,
    const solver_options *options, solver_report *report)
{
  step_data part = *step;
  real reached = 0, advance = REAL(0.5), z[N];
  int status = line_from(step, data);
  memcpy(z, data->z, sizeof z);
  while (status == OK && reached < 1) {
    const long long before = report->iterations;
    part.h = reached + advance < 1 ? (reached + advance) * step->h : step->h;
    *keep = 0;
    status = newton(&part, data, NULL, NULL, dp, keep, options, report);
    if (status == OK && report->iterations - before <= CONTINUED_ITERATIONS) {
      memcpy(z, data->z, sizeof z);
      reached += advance;
      advance = 2 * advance < 1 - reached ? 2 * advance : 1 - reached;
    } else {
      advance /= 2;
      status = advance < LEAST_ADVANCE ? STATUS(SPURIOUS_SOLUTION) : OK;
      memcpy(data->z, z, sizeof z);
    }
  }
  return status;
}

/* Newton's method from that guess, or by continuation if its solution may be a spurious one. */
static int newton_from_line(const step_data *step, newton_data *data, real *dp, int *keep,
    const solver_options *options, solver_report *report)
{
  const long long before = report->iterations;
  TRY(line_from(step, data));
  *keep = 0;
  TRY(newton(step, data, NULL, NULL, dp, keep, options, report));
  const int is_near = report->iterations - before <= NEARBY_ITERATIONS;
  return is_near ? OK : follow_branch(step, data, dp, keep, options, report);
}

#if defined(SPURIOUS_TESTED) && defined(STAGE_POWER)
/* Detection of spurious solutions of Newton's method. Requires: stage_error.h if the stages have an error estimate. */

#define MOST_ERROR 1.0 /* of a step, relative to the state: beyond it the solution may be a spurious one */
#define NEARLY_LINEAR 8 /* iterations: equations solved by so few have one solution nearby, however stiff */

/* Returns 1 if converged stages, after so many iterations, have an inadmissible error estimate. */
static SELDOM int is_spurious(const step_data *step, const real *z, const real *dq, long long iterations)
{
  if (iterations <= NEARLY_LINEAR)
    return 0;
  return !(MATH(pow)(stage_error(step, z, dq, ALL, DECAY, 0, 0), STAGE_POWER) <= MOST_ERROR);
}
#else
#define is_spurious(step, z, dq, iterations) ((void)(iterations), 0)
#endif
