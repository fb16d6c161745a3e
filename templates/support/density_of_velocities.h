/* Arguments of the step density: positions and velocities. Requires: legendre.h. */
static int density_arguments(const step_data *step, real *u)
{
  memcpy(u, step->q0, sizeof(real) * M);
  return NAME(velocity)(step->t, step->q0, step->p0, step->parameters, u + M, step->scratch);
}
