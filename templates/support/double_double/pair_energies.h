#include "pair_states.h"

/* Momenta p = L_v, velocities, energies and momentum maps in pairs; times have two words. */

int NAME(momentum)(const double *t, const double *q, const double *v, const double *parameters, double *p,
    double *workspace)
{
  dd positions[M], velocity[M], result[M];
  load_pairs(q, positions);
  load_pairs(v, velocity);
  TRY(momenta_of(dd_of(t[0], t[1]), positions, velocity, parameters, result, workspace));
  return store_pairs(result, p);
}

int NAME(velocity)(const double *t, const double *q, const double *p, const double *parameters, double *v,
    double *workspace)
{
  dd positions[M], momentum[M], result[M];
  load_pairs(q, positions);
  load_pairs(p, momentum);
  TRY(velocities_of(dd_of(t[0], t[1]), positions, momentum, parameters, result, workspace));
  return store_pairs(result, v);
}

static int energy_of(dd t, const double *q, const double *p, const double *parameters, double *energy,
    double *workspace)
{
  dd u[2 * M], sum;
  load_pairs(q, u);
#ifdef HAMILTONIAN_SYSTEM
  load_pairs(p, u + M);
  hamiltonian_pairs(u, t, parameters, &sum);
#else
  dd momentum[M], value;
  load_pairs(p, momentum);
  TRY(velocities_of(t, u, momentum, parameters, u + M, workspace));
  lagrangian_pairs(u, t, parameters, &value);
  sum = dd_negative(value);
  for (int i = 0; i < M; i++)
    sum = dd_add(sum, dd_multiply(momentum[i], u[M + i]));
#endif
  energy[0] = sum.high;
  energy[1] = sum.low;
  return all_finite(energy, 2) ? OK : NOT_FINITE;
}

int NAME(energy)(double t, const double *q, const double *p, const double *parameters, double *energy,
    double *workspace)
{
  return energy_of(dd_of(t, 0.0), q, p, parameters, energy, workspace);
}

int NAME(energies)(long long count, const double *t, const double *q, const double *p, const double *parameters,
    double *energy, double *workspace)
{
  for (long long k = 0; k < count; k++)
    TRY(energy_of(dd_of(t[2 * k], t[2 * k + 1]), q + k * 2 * M, p + k * 2 * M, parameters, energy + 2 * k, workspace));
  return OK;
}

#ifdef MOMENTUM_MAPS
/* The momentum maps of an array of states, high words, then low words, and the sizes of their terms. */
int NAME(momentum_maps)(long long count, const double *t, const double *q, const double *p, const double *parameters,
    double *map, double *size)
{
  for (long long k = 0; k < count; k++) {
    dd u[2 * M], value[2 * MAPS];
    load_pairs(q + k * 2 * M, u);
    load_pairs(p + k * 2 * M, u + M);
    momentum_maps_pairs(u, dd_of(t[2 * k], t[2 * k + 1]), parameters, value);
    for (int j = 0; j < MAPS; j++) {
      map[(2 * k) * MAPS + j] = value[j].high;
      map[(2 * k + 1) * MAPS + j] = value[j].low;
      if (size)
        size[k * MAPS + j] = sqrt(value[MAPS + j].high);
    }
    TRY(all_finite(map + 2 * k * MAPS, 2 * MAPS) ? OK : NOT_FINITE);
  }
  return OK;
}
#endif

#ifdef TIME_TRANSFORMATION
/* Rates dt/dtau of an array of states. Requires: the kernel integrands_pairs at u = (q, velocities (unused), p). */
int NAME(rates)(long long count, const double *q, const double *p, const double *parameters, double *rate)
{
  for (long long k = 0; k < count; k++) {
    dd u[3 * M], value[INTEGRALS];
    memset(u, 0, sizeof u);
    load_pairs(q + k * 2 * M, u);
    load_pairs(p + k * 2 * M, u + 2 * M);
    integrands_pairs(u, dd_of(0.0, 0.0), parameters, value);
    rate[2 * k] = value[0].high;
    rate[2 * k + 1] = value[0].low;
    if (!all_finite(rate + 2 * k, 2) || value[0].high <= 0.0)
      return NOT_FINITE;
  }
  return OK;
}
#endif
