/* Velocities dq/dt as arguments of event functions of a time-transformed system, whose integrator has dq/dtau, and the
 * duration of a part h of a step in tau. Requires: status_codes.h. */
static int event_velocity(real t, const real *q, const real *p, const real *parameters, real *v, real *workspace)
{
  real rate;
  int status = NAME(velocity)(t, q, p, parameters, v, workspace);
  if (status == OK)
    status = NAME(rates)(1, q, p, parameters, &rate);
  for (int i = 0; status == OK && i < M; i++)
    v[i] /= rate;
  return status;
}

static inline real duration_of_part(real h, const solver_report *part)
{
  (void)h;
  return part->duration;
}
