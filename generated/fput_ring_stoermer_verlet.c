/* FPUT ring: Stoermer-Verlet (Lobatto IIIA-IIIB pair of two stages); see fput_ring_stoermer_verlet.h. */
#include "fput_ring_stoermer_verlet.h"

#include <float.h>
#include <limits.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#define NAME(word) fput_ring_stoermer_verlet_##word /* prefix of every exported name */
#define STATUS(word) FPUT_RING_STOERMER_VERLET_##word
#define ARRAYS /* the number of coordinates is known at run time */
#define TOLERANCE 2.220446049250313e-16 /* default */

enum {
  M = 1, /* coordinates in a vector */
  COORDINATE_ARRAYS = 1,
  MAX_ITERATIONS = 50, /* default */
  MOST_THREADS = 64, /* that share a step */
  TABLES = 0,
  FIELDS = 0,
  SCALARS = 1, /* parameters before the fields */
  WORK = 7, /* numbers per coordinate for steps */
  CONTINUED = 0 /* whether predictors are extrapolated, else forces are used again */
};

#include "support/core/numbers.h"
#include "support/core/status_codes.h"
#include "support/arrays/arrays.h"
#include "support/core/step.h"

/* A mass. Operations: constants. */
static void mass_0(const double *u, double t, const double *parameters, double *value)
{
  value[0] = 1.0;
}

/* The term. Operations: 5 *, 1 +, 1 -. */
static void term_0(const double *u, double t, const double *parameters, double *value)
{
  const double w0 = u[0] - u[1];
  const double w1 = w0 * w0;
  value[0] = (-0.25) * (2.0 * w1 + parameters[0] * (w1 * w1));
}

/* Derivatives with respect to its coordinates. Operations: 3 *, 1 +, 2 -, 1 neg. */
static void force_0(const double *u, double t, const double *parameters, double *value)
{
  const double w0 = u[0] - u[1];
  const double w1 = parameters[0] * (w0 * w0 * w0) - u[1] + u[0];
  value[0] = -w1;
  value[1] = w1;
}

/* mass of q[i] */
static void add_mass_0(const problem *arrays, double *mass)
{
  const long long size_N = arrays->size[0];
  const long long start_q = 0;
  double value[1];
  double parameters[1] = {0};
  parameters[0] = arrays->parameters[0];
  for (long long index_i = 0; index_i < size_N; index_i++) {
    mass_0(NULL, 0.0, parameters, value);
    mass[start_q + index_i] += value[0];
  }
}

/* sum(i in N periodic, -beta*(q[i+1] - q[i])**4/4 - (q[i+1] - q[i])**2/2) */
static void sum_term_0(const problem *arrays, const double *q, double t, compensated *total)
{
  const long long size_N = arrays->size[0];
  const long long start_q = 0;
  double u[2];
  double value[1];
  double parameters[1] = {0};
  parameters[0] = arrays->parameters[0];
  for (long long begin = 0, end; begin < size_N; begin = end) {
    end = size_N;
    const long long shift_i_plus_1 = around(begin, 1, size_N, &end);
    for (long long index_i = begin; index_i < end; index_i++) {
      u[0] = q[start_q + index_i + shift_i_plus_1];
      u[1] = q[start_q + index_i];
      term_0(u, t, parameters, value);
      add_to_sum(total, value[0]);
    }
  }
}

/* Number of coordinates, and the numbers of entries of the fields. */
static long long coordinates_of(const problem *arrays)
{
  const long long size_N = arrays->size[0];
  return size_N;
}

static void field_lengths(const problem *arrays, long long *length)
{
  (void)length;
}

static int compute_inverse_masses(const problem *arrays, double *inverse_mass)
{
  memset(inverse_mass, 0, sizeof(double) * (size_t)coordinates_of(arrays));
  add_mass_0(arrays, inverse_mass);
  return invert_masses(inverse_mass, coordinates_of(arrays));
}

static void state_energies(const problem *arrays, double t, const double *q, const double *p,
    const double *inverse_mass, double *energies)
{
  compensated kinetic = {0.0, 0.0}, terms = {0.0, 0.0};
  add_kinetic_energy(&kinetic, p, inverse_mass, coordinates_of(arrays));
  sum_term_0(arrays, q, t, &terms);
  energies[0] = kinetic.sum + kinetic.rest;
  energies[1] = -(terms.sum + terms.rest);
  energies[2] = (kinetic.sum - terms.sum) + (kinetic.rest - terms.rest);
}

typedef double lanes, times; /* one point at a time */
enum { CHUNK = 512 }; /* values computed before any is added */

static inline void describe_coordinate_arrays(const problem *arrays, coordinate_array *all)
{
  const long long size_N = arrays->size[0];
  long long end = 0;
  end = append_array(&all[0], end, size_N, 1);
}

enum { LEAPS = 2 };
static const double KICK[2] = {0.5, 0.5};
static const double DRIFT[2] = {1.0, 0.0};
static const double KICK_ABSCISSA[2] = {0.0, 1.0};
#define NO_ERROR_ESTIMATE
enum { EQUAL_MASSES = 1 }; /* for all parameters */
#define TOGETHER 128 /* steps that are checked at once */

#define ROWS
enum {
  REACH = 1,
  CHUNKED_ROWS = 1,
  FUSED = 1,
  FRESH = 1
};
#define share_rows share_force_0

static long long rows_of(const problem *arrays)
{
  const long long size_N = arrays->size[0];
  return size_N;
}

#include "support/arrays/array_splitting.h"

/* sum(i in N periodic, -beta*(q[i+1] - q[i])**4/4 - (q[i+1] - q[i])**2/2) */
static void add_force_0(const problem *arrays, const lanes *X, times t, double by, lanes *F, const window *here,
    sweep *of)
{
  const long long size_N = arrays->size[0];
  const long long start_q = 0;
  lanes u[2];
  lanes value[2];
  double parameters[1] = {0};
  parameters[0] = arrays->parameters[0];
  for (long long begin = here->of.first, end; begin < here->of.end; begin = end) {
    end = here->of.end - begin > CHUNK ? begin + CHUNK : here->of.end;
    const long long shift_i_plus_1 = around(begin, 1, size_N, &end);
    lanes values[1][CHUNK];
    for (long long index_i = begin; index_i < end; index_i++) {
      u[0] = X[start_q + index_i + shift_i_plus_1];
      u[1] = X[start_q + index_i];
      force_0(u, t, parameters, value);
      values[0][index_i - begin] = value[1];
    }
    const section part_0 = {begin + shift_i_plus_1, end + shift_i_plus_1};
    const section part_1 = {begin, end};
    const section common_0 = overlap(part_0, part_1);
    lanes *restrict row_0 = F + start_q + 0;
    add_ends(row_0, values[0], -by, part_0, common_0);
    add_ends(row_0, values[0], by, part_1, common_0);
    const addend added[] = {{values[0] + (common_0.first - part_0.first), -1.0}, {values[0] +
        (common_0.first - part_1.first), +1.0}};
    complete_sums(of, by, row_0, common_0, added, 2);
  }
}

/* Its rounds of tasks. */
static sharing share_force_0(const run_memory *run, const problem *arrays, long long n)
{
  const long long size_N = arrays->size[0];
  return alternating_blocks(0, size_N, 1, 1);
}

/* F += by times the forces at X. */
static void add_forces(const run_memory *run, const problem *arrays, const double *X, double t, double by, double *F)
{
  const long long n = coordinates_of(arrays);
  sharing how;
  wait_at_barrier(run);
  how = share_force_0(run, arrays, n);
  for (long long round = 0; round < how.rounds; round++) {
    const section tasks = share_of(run, tasks_in(&how, round));
    for (long long k = tasks.first; k < tasks.end; k++) {
      const window here = window_of(&how, round, k);
      add_force_0(arrays, X, t, by, F, &here, NULL);
    }
    wait_at_barrier(run);
  }
}

static void prepare_rows(const sweep *of, section rows)
{
  window here;
  (void)here;
}

static void add_rows(sweep *of, section rows)
{
  window here;
  (void)here;
  here = window_of_rows(share_force_0(of->run, of->arrays, of->work->n), rows);
  add_force_0(of->arrays, of->X, of->t, of->by, of->F, &here, of);
}

static void complete_rows(const sweep *of, section rows)
{
  window here;
  (void)here;
}

/* Returns 1 if there is enough work for more than one thread. */
static inline int is_worth_sharing(const run_memory *run, const problem *arrays)
{
  const long long n = coordinates_of(arrays);
  int shared = blocks_of(n) > 1;
  shared |= share_force_0(run, arrays, n).blocks > 1;
  return shared;
}

#include "support/arrays/array_memory.h"
#include "support/arrays/array_run.h"

#define MOMENTUM_MAPS
enum { MAPS = 1 };
#include "support/arrays/array_states.h"

static void describe_maps(const problem *arrays, momentum_map *all)
{
  const long long size_N = arrays->size[0];
  const long long start_q = 0;
  const momentum_map described[] = {
      {start_q, start_q + size_N, 1, 0, 0, TRANSLATION},
  };
  memcpy(all, described, sizeof described);
}
