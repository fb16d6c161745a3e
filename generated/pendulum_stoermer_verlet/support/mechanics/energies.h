#ifndef SUPPORT_ENERGIES_H
#define SUPPORT_ENERGIES_H

#include "../core/numbers.h"
#include "../core/status_codes.h"

/* Momenta p = L_v(q, v, t), velocities and energies E = p v - L of a Lagrangian system; or velocities v = H_p(q, p, t),
 * momenta and energies H of a Hamiltonian system (HAMILTONIAN_SYSTEM). If H is linear in p, MASS_ENTRIES is 0 and
 * velocities do not determine momenta: `momentum` returns SINGULAR. With MOMENTUM_MAPS also first integrals. Requires:
 * legendre.h, the kernel lagrangian or hamiltonian. */

int NAME(momentum)(real t, const real *q, const real *v, const real *parameters, real *p, real *workspace)
{
  return transform(t, q, v, parameters, p, workspace);
}

int NAME(velocity)(real t, const real *q, const real *p, const real *parameters, real *v, real *workspace)
{
  return inverse_transform(t, q, p, parameters, v, workspace);
}

int NAME(energy)(real t, const real *q, const real *p, const real *parameters, real *energy, real *workspace)
{
  real u[2 * M], value[1], sum;
  memcpy(u, q, sizeof(real) * M);
  const int status = NAME(velocity)(t, q, p, parameters, u + M, workspace);
  if (status != OK)
    return status;
  lagrangian(u, t, parameters, value);
  sum = -value[0];
  for (int i = 0; i < M; i++)
    sum += p[i] * u[M + i];
  if (!all_finite(&sum, 1))
    return NOT_FINITE;
  *energy = sum;
  return OK;
}

/* Energies of an array of states. */

int NAME(energies)(long long count, const real *t, const real *q, const real *p, const real *parameters, real *energy,
    real *workspace)
{
  for (long long k = 0; k < count; k++) {
    const int status = NAME(energy)(t[k], q + k * M, p + k * M, parameters, energy + k, workspace);
    if (status != OK)
      return status;
  }
  return OK;
}

#endif
