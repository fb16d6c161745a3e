#include "array_memory.h"

/* Functions of states: Legendre transform, energies and momentum maps, for all states of a call in one loop. Requires:
 * state_energies; with SITE_TRANSFORM find_velocities and find_momenta; with MOMENTUM_MAPS MAPS and describe_maps. */

#ifdef JOINED_STATES
/* The numbers of a state, then those of its momenta or velocities, in the memory of a run. */
static const double *joined(const run_memory *run, const double *q, const double *p)
{
  const long long n = coordinates_of(&run->data);
  memcpy(run->phase_state, q, sizeof(double) * (size_t)n);
  memcpy(run->phase_state + n, p, sizeof(double) * (size_t)n);
  return run->phase_state;
}
#endif

/* Legendre transform: velocities of momenta x or, with `inverse`, momenta of velocities x. */
static int legendre_transform(double t, const double *q, const double *x, const double *parameters, double *y,
    int inverse, double *workspace)
{
  run_memory *run = run_in(workspace);
  TRY(use_parameters(run, parameters));
#ifdef SITE_TRANSFORM
  (inverse ? find_momenta : find_velocities)(&run->data, joined(run, q, x), t, y);
  return OK;
#elif defined(HAMILTONIAN_SYSTEM)
  return SINGULAR; /* unknown */
#else
  for (long long i = 0; i < coordinates_of(&run->data); i++)
    y[i] = inverse ? x[i] / run->inverse_mass[i] : x[i] * run->inverse_mass[i];
  return OK;
#endif
}

int NAME(velocity)(double t, const double *q, const double *p, const double *parameters, double *v, double *workspace)
{
  return legendre_transform(t, q, p, parameters, v, 0, workspace);
}

int NAME(momentum)(double t, const double *q, const double *v, const double *parameters, double *p, double *workspace)
{
  return legendre_transform(t, q, v, parameters, p, 1, workspace);
}

/* Stores the parts of the energies of count states, or their sum only. */
static int energies_of(long long count, const double *t, const double *q, const double *p, const double *parameters,
    double *energy, int parts, double *workspace)
{
  run_memory *run = run_in(workspace);
  const long long n = coordinates_of(&run->data);
  TRY(use_parameters(run, parameters));
  problem arrays = run->data;
#ifdef LISTS
  neighbours list[LISTS] = {{0}}; /* those of a run determine the order of its sums */
  for (int k = 0; k < LISTS; k++)
    *list_of(&arrays, k) = &list[k];
#endif
  for (long long k = 0; k < count; k++) {
    const double *at = q + k * n, *moving = p + k * n;
    double all[3];
#ifdef JOINED_STATES
    at = joined(run, at, moving);
    moving = at + n;
#endif
    state_energies(&arrays, t[k], at, moving, run->inverse_mass, all);
#ifdef SITE_TRANSFORM
    all[0] = all[1] = NAN; /* the terms of H are no parts of the energy */
#endif
    if (parts)
      memcpy(energy + 3 * k, all, sizeof all);
    else
      energy[k] = all[2];
  }
#ifdef LISTS
  for (int k = 0; k < LISTS; k++)
    release(&list[k]);
#endif
  return OK;
}

int NAME(energy_parts)(long long count, const double *t, const double *q, const double *p, const double *parameters,
    double *energy, double *workspace)
{
  return energies_of(count, t, q, p, parameters, energy, 1, workspace);
}

int NAME(energies)(long long count, const double *t, const double *q, const double *p, const double *parameters,
    double *energy, double *workspace)
{
  return energies_of(count, t, q, p, parameters, energy, 0, workspace);
}

int NAME(energy)(double t, const double *q, const double *p, const double *parameters, double *energy,
    double *workspace)
{
  return energies_of(1, &t, q, p, parameters, energy, 0, workspace);
}

#ifdef MOMENTUM_MAPS
/* Momentum map of the coordinates of an array: of a translation along a component (of all if `components` is 1), of a
 * rotation of two of them, or of a phase rotation. */
typedef struct {
  long long first, end;
  int components, component, other, kind;
} momentum_map;
enum { TRANSLATION,
  ROTATION,
  PHASE };

static void describe_maps(const problem *arrays, momentum_map *all);

static void add_map(const momentum_map *of, const double *q, const double *p, double *map, double *size)
{
  compensated total = {0.0, 0.0};
  double magnitude = 0.0;
  for (long long i = of->first; i < of->end; i += of->components) {
    const long long a = i + of->component, b = i + of->other;
    if (of->kind == TRANSLATION) {
      add_to_sum(&total, p[a]);
      magnitude += fabs(p[a]);
    } else if (of->kind == PHASE) {
      const double term = (q[i] * q[i] + p[i] * p[i]) / 2.0;
      add_to_sum(&total, term);
      magnitude += term;
    } else {
      add_to_sum(&total, q[a] * p[b]);
      add_to_sum(&total, -q[b] * p[a]);
      magnitude += fabs(q[a] * p[b]) + fabs(q[b] * p[a]);
    }
  }
  *map = total.sum + total.rest;
  *size = magnitude;
}

int NAME(momentum_maps)(long long count, const double *t, const double *q, const double *p, const double *parameters,
    double *map, double *size, double *workspace)
{
  const run_memory *run = run_in(workspace);
  const long long n = coordinates_of(&run->data);
  momentum_map all[MAPS];
  describe_maps(&run->data, all);
  for (long long k = 0; k < count; k++)
    for (int j = 0; j < MAPS; j++) {
      double magnitude;
      add_map(&all[j], q + k * n, p + k * n, map + k * MAPS + j, &magnitude);
      if (size)
        size[k * MAPS + j] = magnitude;
    }
  return OK;
}
#endif
