/* What the density of steps is a function of: positions and momenta. Before it: step.h. */
static int density_arguments(const step_data *step, real *u)
{
  memcpy(u, step->q0, sizeof(real) * M);
  memcpy(u + M, step->p0, sizeof(real) * M);
  return OK;
}
