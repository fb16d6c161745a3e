#include "../core/step.h"
#include "arrays.h"
#include <stddef.h>

#ifdef CONSTRAINTS_OF_ARRAYS
#include "../constraints/constraint_matrix.h"
#endif

/* Memory of a run over arrays, and its parameters. Requires: WORK, the numbers of work per coordinate; SCALARS, the
 * number of parameters before the fields; CONTINUED, whether predictors are extrapolated; field_lengths,
 * compute_inverse_masses; with CONSTRAINTS_OF_ARRAYS count_constraints, with NEWTON_KRYLOV envelope.h. */

#define ALIGNED_NUMBERS 8 /* in 64 bytes, the widest SIMD register */

/* The run in a workspace. */
static run_memory *run_in(double *workspace)
{
  return (run_memory *)(void *)workspace;
}

/* The next `count` numbers of a memory, from *end on; NULL without memory. */
static void *next_numbers(double *memory, long long *end, long long count)
{
  double *const here = memory ? memory + *end : NULL;
  *end += (count + ALIGNED_NUMBERS - 1) / ALIGNED_NUMBERS * ALIGNED_NUMBERS;
  return here;
}

/* Number of doubles that contain `count` objects of a size. */
static long long doubles_of(long long count, size_t size)
{
  return (count * (long long)size + (long long)sizeof(double) - 1) / (long long)sizeof(double);
}

/* Number of parameters and of the entries of all fields. */
static long long parameters_of(const problem *arrays)
{
  long long length[FIELDS + 1], count = SCALARS;
  field_lengths(arrays, length);
  for (int k = 0; k < FIELDS; k++)
    count += length[k];
  return count;
}

#ifdef CONSTRAINTS_OF_ARRAYS
/* Number of indices of the pattern of constraints. */
static long long indices_of(const run_memory *run, long long n)
{
  return 3 * (run->constraints + run->entries) + n + 3;
}

/* Counts constraints, their nonzero derivatives and the pairs that share a coordinate; 0 without memory for them. */
static int count_pairs(run_memory *run)
{
  count_constraints(&run->data, run);
  if (run->constraints < 0 || run->entries < run->constraints || run->entries > INT_MAX)
    return 0;
  run->places = calloc((size_t)indices_of(run, coordinates_of(&run->data)), sizeof(int));
  run->columns = NULL;
  run->pairs = run->places ? find_pairs(run) : 0;
  free(run->places);
  return run->places != NULL;
}
#endif

/* Divides the memory of a run, NULL to compute its length, which is returned; -1 without memory. */
static long long divide_memory(run_memory *run, double *memory)
{
  const long long n = coordinates_of(&run->data);
  long long end = 0;
#ifdef CONSTRAINTS_OF_ARRAYS
  if (!count_pairs(run))
    return -1;
#endif
  next_numbers(memory, &end, doubles_of(1, sizeof *run));
  run->q = next_numbers(memory, &end, 2 * n);
  run->carry_q = next_numbers(memory, &end, 2 * n);
  run->p = memory ? run->q + n : NULL;
  run->carry_p = memory ? run->carry_q + n : NULL;
  run->work = next_numbers(memory, &end, WORK * n);
#ifdef CONSTRAINTS_OF_ARRAYS
  run->held = next_numbers(memory, &end, 11 * run->constraints + 2 * (run->entries + run->pairs));
#endif
#ifdef NEWTON_KRYLOV
  if (run->pattern)
    run->factors = next_numbers(memory, &end, numbers_of_factors(run->pattern, n));
#endif
  run->saved = end * (long long)sizeof(double) - (long long)offsetof(run_memory, t);
#ifdef NEWTON_KRYLOV
  if (run->pattern)
    run->compared_factors = next_numbers(memory, &end, numbers_of_factors(run->pattern, n));
#endif
  run->inverse_mass = next_numbers(memory, &end, n);
#ifdef HEAT_BATH
  run->bath = next_numbers(memory, &end, 5 * n);
#endif
  run->values = next_numbers(memory, &end, parameters_of(&run->data));
  run->phase_state = next_numbers(memory, &end, 2 * n);
#ifdef CONSTRAINTS_OF_ARRAYS
  run->places = next_numbers(memory, &end, doubles_of(indices_of(run, n), sizeof(int)));
  run->columns = next_numbers(memory, &end, doubles_of(run->pairs + 1, sizeof(int)));
#endif
#ifdef LISTS
  for (int k = 0; k < LISTS; k++)
    *list_of(&run->data, k) = next_numbers(memory, &end, doubles_of(1, sizeof(neighbours)));
#endif
  return end;
}

/* A run of these sizes and tables, without memory. */
static run_memory run_of(const long long *sizes, const int *const *tables)
{
  run_memory run = {0};
  for (int k = 0; k < STATUS(SIZES); k++)
    run.data.size[k] = sizes[k];
  for (int k = 0; k < TABLES; k++)
    run.data.table[k] = tables[k];
#ifdef NEWTON_KRYLOV
  run.pattern = tables[TABLES];
#endif
  return run;
}

long long NAME(memory)(const long long *sizes, const int *const *tables)
{
  run_memory run = run_of(sizes, tables);
  return divide_memory(&run, NULL);
}

run_memory *NAME(bind)(const long long *sizes, const int *const *tables, double *memory)
{
  run_memory run = run_of(sizes, tables);
  const long long length = divide_memory(&run, memory);
  if (length < 0)
    return NULL;
  memset(memory, 0, sizeof run);
  memcpy(memory, &run, sizeof run);
#ifdef LISTS
  for (int k = 0; k < LISTS; k++)
    memset(*list_of(&run.data, k), 0, sizeof(neighbours));
#endif
#ifdef CONSTRAINTS_OF_ARRAYS
  find_pairs(&run);
  run_in(memory)->is_exact = is_without_fill(&run);
#endif
  return run_in(memory);
}

#ifdef LISTS
void NAME(release)(run_memory *run)
{
  for (int k = 0; k < LISTS; k++)
    release(*list_of(&run->data, k));
}
#endif

/* Discards the factors of the linear part of a step: their first number is the step size for which they are valid. */
static void discard_factors(run_memory *run)
{
#ifdef NEWTON_KRYLOV
  if (run->factors)
    run->factors[0] = 0.0;
#endif
}

/* Lets the following computations use these parameters and fields; the inverse masses are computed if they are new.
 * Then an extrapolated predictor is kept, reused forces are discarded. */
static int use_parameters(run_memory *run, const double *parameters)
{
  const size_t size = sizeof(double) * (size_t)parameters_of(&run->data);
  long long length[FIELDS + 1];
  const double *next = parameters + (parameters ? SCALARS : 0);
  field_lengths(&run->data, length);
  run->data.parameters = parameters;
  for (int k = 0; k < FIELDS; k++) {
    run->data.field[k] = next;
    next += length[k];
  }
  if (run->has_values && (size == 0 || memcmp(run->values, parameters, size) == 0))
    return OK;
  if (run->has_values) {
    run->is_changed = 1;
    run->guess *= CONTINUED;
    discard_factors(run);
  }
  run->has_values = 0;
  if (size > 0)
    memcpy(run->values, parameters, size);
  TRY(compute_inverse_masses(&run->data, run->inverse_mass));
  run->has_values = 1;
  return OK;
}

const problem *NAME(data_at)(const double *parameters, double *workspace)
{
  run_memory *run = run_in(workspace);
  return use_parameters(run, parameters) == OK ? &run->data : NULL;
}

/* Advances time and counters by a step that took `iterations`. */
static void count_step(run_memory *run, solver_report *report, long long iterations)
{
  add_compensated(&run->t, &run->t_low, run->h, 0.0);
  run->iterations += iterations;
  run->step++;
  report->steps++;
}

void NAME(start)(run_memory *run, double t, double h, const double *q, const double *p)
{
  const size_t size = sizeof(double) * (size_t)coordinates_of(&run->data), head = offsetof(run_memory, t);
  memset((char *)run + head, 0, sizeof *run - head);
  run->t = t;
  run->h = h;
  memcpy(run->q, q, size);
  memcpy(run->p, p, size);
  memset(run->carry_q, 0, 2 * size);
  run->has_values = run->is_changed = 0;
  discard_factors(run);
}
