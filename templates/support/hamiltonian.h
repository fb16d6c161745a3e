/* Momenta, velocities and energies of a Hamiltonian system. If H is linear in p, MASS_ENTRIES is 0 and velocities do
 * not determine momenta: `momentum` returns SINGULAR. Requires: legendre.h, the kernel hamiltonian. */

int NAME(velocity)(real t, const real *q, const real *p, const real *parameters, real *v, real *workspace)
{
  return transform(t, q, p, parameters, v, workspace);
}

int NAME(momentum)(real t, const real *q, const real *v, const real *parameters, real *p, real *workspace)
{
  return MASS_ENTRIES ? inverse_transform(t, q, v, parameters, p, workspace) : SINGULAR;
}

int NAME(energy)(real t, const real *q, const real *p, const real *parameters, real *energy, real *workspace)
{
  real u[2 * M], value[1];
  (void)workspace;
  memcpy(u, q, sizeof(real) * M);
  memcpy(u + M, p, sizeof(real) * M);
  hamiltonian(u, t, parameters, value);
  if (!all_finite(value, 1))
    return NOT_FINITE;
  *energy = value[0];
  return OK;
}
