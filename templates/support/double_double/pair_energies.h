#include "../core/status_codes.h"

/* Momenta p = m v, energies and momentum maps in pairs. */

static inline void load_pairs(const double *words, dd *x)
{
  for (int i = 0; i < M; i++)
    x[i] = dd_of(words[i], words[M + i]);
}

static int store_pairs(const dd *x, double *words)
{
  for (int i = 0; i < M; i++)
    words[i] = x[i].high, words[M + i] = x[i].low;
  return all_finite(words, 2 * M) ? OK : NOT_FINITE;
}

int NAME(momentum)(double t, const double *q, const double *v, const double *parameters, double *p, double *workspace)
{
  dd masses[M], velocity[M];
  (void)q, (void)workspace;
  mass_pairs(NULL, dd_of(t, 0.0), parameters, masses);
  load_pairs(v, velocity);
  for (int i = 0; i < M; i++)
    velocity[i] = dd_multiply(masses[i], velocity[i]);
  return store_pairs(velocity, p);
}

static void velocities_of(dd t, const double *p, const double *parameters, dd *velocity)
{
  dd masses[M];
  mass_pairs(NULL, t, parameters, masses);
  load_pairs(p, velocity);
  for (int i = 0; i < M; i++)
    velocity[i] = dd_divide(velocity[i], masses[i]);
}

int NAME(velocity)(double t, const double *q, const double *p, const double *parameters, double *v, double *workspace)
{
  dd velocity[M];
  (void)q, (void)workspace;
  velocities_of(dd_of(t, 0.0), p, parameters, velocity);
  return store_pairs(velocity, v);
}

static int energy_of(dd t, const double *q, const double *p, const double *parameters, double *energy)
{
  dd u[2 * M], sum;
  load_pairs(q, u);
#ifdef HAMILTONIAN_SYSTEM
  load_pairs(p, u + M);
  hamiltonian_pairs(u, t, parameters, &sum);
#else
  dd value;
  velocities_of(t, p, parameters, u + M);
  lagrangian_pairs(u, t, parameters, &value);
  sum = dd_negative(value);
  for (int i = 0; i < M; i++)
    sum = dd_add(sum, dd_multiply(dd_of(p[i], p[M + i]), u[M + i]));
#endif
  energy[0] = sum.high;
  energy[1] = sum.low;
  return all_finite(energy, 2) ? OK : NOT_FINITE;
}

int NAME(energy)(double t, const double *q, const double *p, const double *parameters, double *energy,
    double *workspace)
{
  (void)workspace;
  return energy_of(dd_of(t, 0.0), q, p, parameters, energy);
}

int NAME(energies)(long long count, const double *t, const double *q, const double *p, const double *parameters,
    double *energy, double *workspace)
{
  (void)workspace;
  for (long long k = 0; k < count; k++) {
    const int status =
        energy_of(dd_of(t[2 * k], t[2 * k + 1]), q + k * 2 * M, p + k * 2 * M, parameters, energy + 2 * k);
    if (status != OK)
      return status;
  }
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
    if (!all_finite(map + 2 * k * MAPS, 2 * MAPS))
      return NOT_FINITE;
  }
  return OK;
}
#endif
