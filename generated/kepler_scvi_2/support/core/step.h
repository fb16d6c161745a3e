#ifndef SUPPORT_STEP_H
#define SUPPORT_STEP_H

#include "numbers.h"

/* Arguments of a step, and loops over its coordinates: M or, if ARRAYS is defined, n, which is known at run time and
 * which threads share in blocks (arrays.h). Requires: status_codes.h, real. */
typedef NAME(run) run_memory;

/* Range of coordinates. */
typedef struct {
  long long first, end;
} section;

/* Arguments of a step. */
typedef struct {
  real t, h;
  const real *q0, *p0, *carry_q, *carry_p, *parameters;
  real *scratch; /* SCRATCH numbers */
  int first; /* 1 if the workspace contains nothing of the previous step */
  const struct predictor_tables_of *tables; /* predictor tables; NULL: those of fixed steps */
} step_data;

/* Arguments of a step from a state with its compensation terms. */
static inline step_data step_from(real t, real h, const real *q, const real *p, const real *carry_q,
    const real *carry_p, const real *parameters, real *workspace)
{
  const step_data step = {.t = t,
      .h = h,
      .q0 = q,
      .p0 = p,
      .carry_q = carry_q,
      .carry_p = carry_p,
      .parameters = parameters,
      .scratch = workspace,
      .first = 1};
  return step;
}

#define EACH_BLOCK(all) /* there is one */

/* Sums or maxima over all coordinates. */
typedef struct {
  section here;
  real values[2];
} sums;

static inline void begin_blocks(sums *all, const step_data *step)
{
  const section every = {0, M};
  (void)step;
  all->here = every;
}

static inline void add_block(sums *all, real one, real other)
{
  all->values[0] = one;
  all->values[1] = other;
}

static inline real largest_over(const sums *all, int which)
{
  return all->values[which];
}

static inline void meet(const step_data *step)
{
  (void)step;
}

static inline section own_part(const step_data *step)
{
  const section every = {0, M};
  (void)step;
  return every;
}

/* Returns 1 if the increments, without their low words, lead to a finite state. */
static inline int reaches(const step_data *step, const real *dq, const real *dp)
{
  sums all;
  begin_blocks(&all, step);
  EACH_BLOCK (all) {
    int faults = 0;
    for (long long i = all.here.first; i < all.here.end; i++) {
      faults |= !is_finite(step->q0[i] + dq[i]);
      faults |= !is_finite(step->p0[i] + dp[i]);
    }
    add_block(&all, (real)faults, 0);
  }
  meet(step);
  return largest_over(&all, 0) == 0;
}

#endif
