/* Velocities that functions of events are given. Before it: answers.h. */
static int event_velocity(real t, const real *q, const real *p, const real *parameters, real *v, real *workspace)
{
  return NAME(velocity)(t, q, p, parameters, v, workspace);
}
