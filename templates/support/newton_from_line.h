/* Newton's method without previous steps. Requires: newton.h. */

/* Initial guess: q moves on a straight line with its initial velocity. */
static int line_from(const step_data *step, const newton_data *data)
{
  real v[M];
  const int status = NAME(velocity)(step->t, step->q0, step->p0, step->parameters, v, step->scratch);
  if (status == OK)
    start_on_line(v, step->p0, data->z);
  return status;
}

/* Newton's method from that guess. */
static int newton_from_line(const step_data *step, const newton_data *data, real *dp, int *keep,
    const solver_options *options, solver_report *report)
{
  const int status = line_from(step, data);
  if (status != OK)
    return status;
  *keep = 0;
  return newton(step, data, NULL, NULL, dp, keep, options, report);
}
