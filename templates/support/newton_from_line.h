/* Newton's iteration without former steps. Before it: newton.h. */

/* Newton's iteration from the guess that q moves on a straight line with its initial velocity. */
static int newton_from_line(const step_data *step, const newton_data *data, real *dp, int *keep,
    const solver_options *options, solver_report *report)
{
  real v[M];
  const int status = NAME(velocity)(step->t, step->q0, step->p0, step->parameters, v, step->scratch);
  if (status != OK)
    return status;
  place_on_line(v, step->p0, data->z);
  *keep = 0;
  return newton(step, data, NULL, NULL, dp, keep, options, report);
}
