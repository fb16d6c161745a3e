#include "constraints.h"

/* What contacts by steps (run/contact_steps.h) are made of. Requires: the kernels motion_by_steps, masses_by_steps,
 * constraints, drifts and contact_coefficients. */

/* With `all` also L_vq and f_v; entries that are always 0 are not written. */
int NAME(motion_terms)(real t, const real *q, const real *v, const real *parameters, int all, real *terms)
{
  real u[2 * M], derivative[MOTION_ENTRIES], *const mass = terms + 2 * M;
  const int count = all ? MOTION_ENTRIES : MOTION_MASSES;
  memcpy(u, q, sizeof(real) * M);
  memcpy(u + M, v, sizeof(real) * M);
  if (all)
    motion_by_steps(u, t, parameters, terms, derivative);
  else
    masses_by_steps(u, t, parameters, terms, derivative);
  for (int e = 0; e < count; e++)
    mass[MOTION_PLACE[e]] = derivative[e];
  for (int i = 0; i < M; i++)
    for (int j = 0; j < i; j++)
      mass[j * M + i] = mass[i * M + j];
  return all_finite(terms, 2 * M) && all_finite(derivative, count) ? OK : NOT_FINITE;
}

/* Friction, static friction and restitution of the contacts. */
int NAME(contact_laws)(real t, const real *q, const real *v, const real *parameters, real *laws)
{
  real u[2 * M];
  memcpy(u, q, sizeof(real) * M);
  memcpy(u + M, v, sizeof(real) * M);
  contact_coefficients(u, t, parameters, laws);
  return OK;
}

/* Entries of G that are always 0 are not written. */
int NAME(row_terms)(real t, const real *q, const real *v, const real *parameters, real *terms)
{
  real u[2 * M], derivative[CONSTRAINT_ENTRIES], *const G = terms + 2 * CONSTRAINTS;
  memcpy(u, q, sizeof(real) * M);
  memcpy(u + M, v, sizeof(real) * M);
  constraints(u, t, parameters, terms, derivative);
  drifts(u, t, parameters, terms + CONSTRAINTS);
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++)
    G[CONSTRAINT_ENTRY[e][0] * M + CONSTRAINT_ENTRY[e][1]] = derivative[e];
  contact_coefficients(u, t, parameters, G + CONSTRAINTS * M);
  return all_finite(terms, 2 * CONSTRAINTS) && all_finite(derivative, CONSTRAINT_ENTRIES) ? OK : NOT_FINITE;
}
