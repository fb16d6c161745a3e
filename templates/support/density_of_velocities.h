/* What the density of steps is a function of: positions and velocities. Before it: legendre.h. */
static int density_arguments(const step_data *step, real *u)
{
  memcpy(u, step->q0, sizeof(real) * M);
  return NAME(velocity)(step->t, step->q0, step->p0, step->parameters, u + M, step->scratch);
}
