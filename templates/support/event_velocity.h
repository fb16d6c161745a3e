/* Velocities as arguments of event functions, and the duration of a part h of a step. Requires: status_codes.h. */
static int event_velocity(real t, const real *q, const real *p, const real *parameters, real *v, real *workspace)
{
  return NAME(velocity)(t, q, p, parameters, v, workspace);
}

static inline real duration_of_part(real h, const solver_report *part)
{
  (void)part;
  return h;
}
