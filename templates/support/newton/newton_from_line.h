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

/* Sign of the determinant of a factorised matrix. */
static int sign_of_determinant(const real *a, const band *shape, const real *pivot)
{
  int sign = 1;
  for (int k = 0; k < shape->rows; k++)
    if (((int)pivot[k] == k) == (a[shape->first + k * (shape->stride + 1)] < 0))
      sign = -sign;
  return sign;
}

/* Stages that solve the equations with a step size near 0 belong to a branch, on which those of the step lie. Newton's
 * method from far away may converge to another root, a spurious solution: so may every method, and steps of one stage
 * have no error estimate that shows it. Roots that are not near the line are computed by continuation in the step size
 * (Deuflhard, Newton Methods for Nonlinear Problems, sec. 5.1): from the stages at one size to those nearby at a larger
 * one. The branch ends, or turns back, where the Jacobian is singular: on it the determinant keeps its sign. */
#define LEAST_ADVANCE REAL(0.00390625) /* of the step size */

/* Follows the branch from the line to the stages at step->h, with the results of newton and the factors at the
 * root. If it ends before, returns SPURIOUS_SOLUTION where another root was found, else NOT_CONVERGED. */
static SELDOM int follow_branch(const step_data *step, newton_data *data, real *dp, int *keep,
    const solver_options *options, solver_report *report)
{
  const band shape = band_of(SITES, B);
  step_data part = *step;
  real reached = 0, advance = LEAST_ADVANCE, z[N], size_p[SITES], size_q[M];
  int sign = 0, status = OK;
  TRY(line_from(step, data));
  while (reached < 1 && advance >= LEAST_ADVANCE) {
    memcpy(z, data->z, sizeof z);
    part.h = reached + advance < 1 ? (reached + advance) * step->h : step->h;
    *keep = 0;
    status = newton(&part, data, NULL, NULL, dp, keep, options, report);
    if (status == OK && *keep) /* the factors are those of another iterate, else the Jacobian has none yet */
      evaluate(&part, data->z, data->rows, size_p, size_q, data->factors, &shape);
    if (status == OK && !linearise(&part, data, &shape))
      status = SINGULAR;
    const int there = sign_of_determinant(data->factors, &shape, data->pivot);
    sign = reached > 0 ? sign : there;
    if (status == OK && there == sign) {
      reached += advance;
      advance *= 2;
    } else {
      advance /= 2;
      memcpy(data->z, z, sizeof z);
    }
  }
  *keep = reached >= 1;
  if (*keep)
    return OK;
  return status == OK ? STATUS(SPURIOUS_SOLUTION) : NOT_CONVERGED;
}

/* Newton's method from that guess. */
static int newton_on_line(const step_data *step, newton_data *data, real *dp, int *keep,
    const solver_options *options, solver_report *report)
{
  TRY(line_from(step, data));
  *keep = 0;
  return newton(step, data, NULL, NULL, dp, keep, options, report);
}

/* The same, or by continuation if its solution may be a spurious one. */
static int newton_from_line(const step_data *step, newton_data *data, real *dp, int *keep,
    const solver_options *options, solver_report *report)
{
  const int status = newton_on_line(step, data, dp, keep, options, report);
  return status == STATUS(SPURIOUS_SOLUTION) ? follow_branch(step, data, dp, keep, options, report) : status;
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
