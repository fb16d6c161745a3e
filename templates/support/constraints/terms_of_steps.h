#include "constraints.h"

/* What contacts by steps (run/contact_steps.h) are made of. Requires: the kernels motion_by_steps, constraints, drifts
 * and contact_coefficients. */

int NAME(motion_terms)(real t, const real *q, const real *v, const real *parameters, real *terms)
{
  real u[2 * M], derivative[MOTION_ENTRIES], *const by_state = terms + 2 * M;
  memcpy(u, q, sizeof(real) * M);
  memcpy(u + M, v, sizeof(real) * M);
  motion_by_steps(u, t, parameters, terms, derivative);
  memset(by_state, 0, sizeof(real) * 4 * M * M);
  for (int e = 0; e < MOTION_ENTRIES; e++)
    by_state[MOTION_ENTRY[e][0] * 2 * M + MOTION_ENTRY[e][1]] = derivative[e];
  return all_finite(terms, 2 * M) && all_finite(derivative, MOTION_ENTRIES) ? OK : NOT_FINITE;
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

int NAME(row_terms)(real t, const real *q, const real *v, const real *parameters, real *terms)
{
  real u[2 * M], derivative[CONSTRAINT_ENTRIES], *const G = terms + 2 * CONSTRAINTS;
  memcpy(u, q, sizeof(real) * M);
  memcpy(u + M, v, sizeof(real) * M);
  constraints(u, t, parameters, terms, derivative);
  drifts(u, t, parameters, terms + CONSTRAINTS);
  memset(G, 0, sizeof(real) * CONSTRAINTS * M);
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++)
    G[CONSTRAINT_ENTRY[e][0] * M + CONSTRAINT_ENTRY[e][1]] = derivative[e];
  contact_coefficients(u, t, parameters, G + CONSTRAINTS * M);
  return all_finite(terms, 2 * CONSTRAINTS) && all_finite(derivative, CONSTRAINT_ENTRIES) ? OK : NOT_FINITE;
}
