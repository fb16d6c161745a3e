/* Arguments of the step density: positions and momenta. Requires: step.h. */
static int density_arguments(const step_data *step, real *u)
{
  memcpy(u, step->q0, sizeof(real) * M);
  memcpy(u + M, step->p0, sizeof(real) * M);
  return OK;
}
