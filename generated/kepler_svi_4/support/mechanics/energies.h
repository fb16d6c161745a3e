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

/* Momentum maps (first integrals from symmetries; Noether) of an array of states, and the sizes of their terms.
 * Requires: MAPS, the kernel momentum_maps. */

int NAME(momentum_maps)(long long count, const real *t, const real *q, const real *p, const real *parameters, real *map,
    real *size)
{
  for (long long k = 0; k < count; k++) {
    real u[2 * M], value[2 * MAPS];
    memcpy(u, q + k * M, sizeof(real) * M);
    memcpy(u + M, p + k * M, sizeof(real) * M);
    momentum_maps(u, t[k], parameters, value);
    if (!all_finite(value, MAPS))
      return NOT_FINITE;
    for (int j = 0; j < MAPS; j++) {
      map[k * MAPS + j] = value[j];
      if (size)
        size[k * MAPS + j] = MATH(sqrt)(value[MAPS + j]);
    }
  }
  return OK;
}

#endif
