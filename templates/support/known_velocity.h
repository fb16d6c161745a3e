/* Initial velocity of a curve from p0. Requires: HAMILTONIAN, 1 for Hamiltonian systems. */
static int nearby_velocity(const step_data *step, double *v0)
{
  double u[2 * M];
  int status;
  if (HAMILTONIAN)
    return NAME(velocity)(step->t, step->q0, step->p0, step->parameters, v0, step->scratch);
  memcpy(u, step->q0, sizeof(double) * M);
  memcpy(u + M, v0, sizeof(double) * M);
  status = invert_from(step->t, u, step->p0, step->parameters, step->scratch);
  memcpy(v0, u + M, sizeof(double) * M);
  return status;
}
