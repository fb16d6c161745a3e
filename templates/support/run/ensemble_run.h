#include "../core/scalars.h"
#include "../core/trajectories.h"

/* Ensemble runs with compensated sums; trajectories are SIMD lanes. Requires: trajectories.h, numbers.h, and
 * prepare_iteration and fixed_point of a solver, which compute the increments of a step; EXPLICIT_STEPS if it does not
 * repeat a failed step. */

#if defined(DOUBLE_DOUBLE) || defined(SINGLE_PRECISION)
#define LOW_WORD(of, name) (of)->name##_low
#else
#define LOW_WORD(of, name) 0
#endif

#if defined(DOUBLE_DOUBLE) && !defined(EXPLICIT_STEPS)
#define THREE_WORDS /* of the sums of increments */
#define CARRIES (2 * M) /* low words, then third words */
#else
#define CARRIES M
#endif

/* The part of a block that a step changes, its first members; in local memory during a call. */
typedef struct {
  lanes q[M], p[M], carry_q[CARRIES], carry_p[CARRIES];
} state;

#ifdef THREE_WORDS
/* x + carry += increment, each with its further words, in active lanes. */
static void add_increments(lanes *x, lanes *carry, const lanes *increment, const real *active)
{
  for (int i = 0; i < M; i++) {
    lane_view sum = {x[i]}, low = {carry[i]}, lowest = {carry[M + i]};
    const lane_view high = {increment[i]}, rest = {increment[M + i]};
    for (int j = 0; j < LANES; j++) {
      double words[] = {sum.lane[j], low.lane[j], lowest.lane[j]};
      add_to_three_words(&words[0], &words[1], &words[2], high.lane[j], rest.lane[j]);
      sum.lane[j] = active[j] > 0.0 ? words[0] : sum.lane[j];
      low.lane[j] = active[j] > 0.0 ? words[1] : low.lane[j];
      lowest.lane[j] = active[j] > 0.0 ? words[2] : lowest.lane[j];
    }
    x[i] = sum.all;
    carry[i] = low.all;
    carry[M + i] = lowest.all;
  }
}
#else
/* x + carry += increment with its low word, in double-double arithmetic, in active lanes. */
static void add_increments(lanes *x, lanes *carry, const lanes *increment, const real *active)
{
  lanes advanced;
  memcpy(&advanced, active, sizeof advanced);
  for (int i = 0; i < M; i++) {
    const lanes sum = x[i] + increment[i], part = sum - x[i];
    const lanes rest = ((x[i] - (sum - part)) + (increment[i] - part)) + (carry[i] + increment[M + i]);
    carry[i] = lanes_selected(advanced, rest - ((sum + rest) - sum), carry[i]);
    x[i] = lanes_selected(advanced, sum + rest, x[i]);
  }
}
#endif

#ifdef SINGLE_PRECISION
/* Returns 1 if a value within a step was too large: 1/r^3 of a large r is a wrong 0. Values that are too small, as
 * parts of sums are now and then, count in the first step only. */
static inline int is_out_of_range(const lanes *dq, const lanes *dp, int first)
{
  __asm__ volatile("" : : "r"(dq), "r"(dp) : "memory"); /* after all of the step */
  const int limits = first ? FE_OVERFLOW | FE_UNDERFLOW : FE_OVERFLOW;
#ifdef __SSE2__
  const int out = (int)__builtin_ia32_stmxcsr() & limits; /* as fetestexcept, at a fraction of its time */
#else
  const int out = fetestexcept(limits);
#endif
  if (out)
    feclearexcept(FE_OVERFLOW | FE_UNDERFLOW);
  return out != 0;
}
#endif

/* Deactivates lanes whose next state is not finite; in single precision all, if a value was out of its range. */
static void drop_infinite(const state *now, const lanes *dq, const lanes *dp, int first, real *active)
{
  lane_view sum = {lanes_of(0.0)};
#ifdef SINGLE_PRECISION
  if (is_out_of_range(dq, dp, first))
    sum.all += REAL(1.0);
#endif
  for (int i = 0; i < M; i++)
    sum.all += 0.0 * (now->q[i] + dq[i]) + 0.0 * (now->p[i] + dp[i]);
  for (int j = 0; j < LANES; j++)
    active[j] = sum.lane[j] == 0.0 ? active[j] : 0.0;
}

#ifdef HEAT_BATH
#include "bath_lanes.h"
#endif
#ifdef OBSERVED
#include "observation.h"
#endif
#ifdef TANGENTS
#include "tangent_growth.h"

enum { SAVED = 5 * TANGENTS }; /* numbers that are saved of a trajectory after a step */
#else
enum { SAVED = WORDS * M };
#endif
void NAME(start)(block_memory *block, double t, double h)
{
  memset(block, 0, sizeof *block);
  block->t = (real)t;
  block->h = (real)h;
#ifdef SINGLE_PRECISION
  block->t_low = (real)(t - block->t);
  block->h_low = (real)(h - block->h);
#endif
#ifdef OBSERVED
  for (int n = 0; n < 3; n++)
    for (int i = 0; i < OBSERVED; i++)
      for (int j = 0; j < LANES; j++)
        block->observed[n][i][j] = NAN;
#endif
}

/* Stores the states of the first `count` trajectories, one row each. */
static void store_states(const state *now, int count, double *q, double *p)
{
  for (int i = 0; i < M; i++) {
    const lane_view position = {now->q[i]}, momentum = {now->p[i]};
    for (int j = 0; j < count; j++) {
      q[j * WORDS * M + i] = position.lane[j];
      p[j * WORDS * M + i] = momentum.lane[j];
    }
#if defined(DOUBLE_DOUBLE) || defined(SINGLE_PRECISION)
    const lane_view low_position = {now->carry_q[i]}, low_momentum = {now->carry_p[i]};
#endif
#ifdef SINGLE_PRECISION
    for (int j = 0; j < count; j++) {
      q[j * M + i] += low_position.lane[j];
      p[j * M + i] += low_momentum.lane[j];
    }
#endif
#ifdef DOUBLE_DOUBLE
    for (int j = 0; j < count; j++) {
      q[(j * WORDS + 1) * M + i] = low_position.lane[j];
      p[(j * WORDS + 1) * M + i] = low_momentum.lane[j];
    }
#endif
  }
}

#ifndef EXPLICIT_STEPS
#ifdef RUN_ACTION
/* Adds the action of a solved step in active lanes. */
static void add_actions(block_memory *block, const step_data *step, const iteration_data *data, history past)
{
  lane_view sum;
  integrals_of_iteration(step, data, past.before, &sum.all);
  for (int j = 0; j < LANES; j++)
    add_compensated(&block->action[j], &block->action_low[j], block->active[j] > 0.0 ? sum.lane[j] : NAN, 0.0);
}

static void store_actions(const block_memory *block, int count, long long place)
{
  if (block->actions)
    memcpy(block->actions + place, block->action, sizeof(double) * (size_t)count);
}
#endif

/* Results of a step of which some trajectories are repeated. */
typedef struct {
  lanes curve[STORED][M], position[2 * M], momentum[2 * M];
  real active[LANES]; /* before the step, or before its repetition */
  long long guess;
  int repeated;
} first_results;

/* Returns 1 if a step has to be repeated for the trajectories that failed in it, from the value at the beginning of the
 * extrapolated curve, as single runs do from the straight line; after that, restores the results of the others. */
static SELDOM int repeats_failed(first_results *stored, history past, long long *guess, lanes *dq, lanes *dp,
    real *active)
{
  lanes *before = &past.before[0][0], *curve = &stored->curve[0][0];
  if (stored->repeated) {
    for (int j = 0; j < LANES; j++) {
      if (stored->active[j] > 0.0) {
        for (int i = 0; i < STORED * M; i++)
          before[i][j] = curve[i][j];
        for (int i = 0; i < 2 * M; i++) {
          dq[i][j] = stored->position[i][j];
          dp[i][j] = stored->momentum[i][j];
        }
        active[j] = stored->active[j];
      } else
        stored->guess &= ~(2LL << j);
    }
    *guess = stored->guess;
    return 0;
  }
  memcpy(stored->curve, past.before, sizeof stored->curve);
  memcpy(stored->position, dq, sizeof stored->position);
  memcpy(stored->momentum, dp, sizeof stored->momentum);
  for (int n = 0; n < S; n++)
    for (int i = 0; i < M; i++)
      past.before[n][i] = apply(LAST_ALONE, 0, past.last, i);
  for (int j = 0; j < LANES; j++) {
    const real succeeded = active[j];
    active[j] = stored->active[j] > 0.0 && !(succeeded > 0.0) ? 1.0 : 0.0;
    stored->active[j] = succeeded;
  }
  stored->repeated = 1;
  stored->guess = *guess;
  *guess = 0;
  return 1;
}
#endif

void NAME(advance)(block_memory *block, int count, long long steps, long long every, const solver_options *options,
    double *q, double *p, long long row_length)
{
  const solver_options standard = {.tolerance = TOLERANCE, .max_iterations = MAX_ITERATIONS};
  state now;
  iteration_data data;
  solver_report report = {.active = block->active};
  lanes parameters[P + 1], memory[2][STORED][M];
#ifndef EXPLICIT_STEPS
  first_results stored_results;
#endif
  lanes dq[2 * M] = {{0.0}}, dp[2 * M] = {{0.0}}; /* increments, then their low words */
  step_data step = {.t = block->t,
      .h = block->h,
      .q0 = now.q,
      .p0 = now.p,
      .carry_q = now.carry_q,
      .carry_p = now.carry_p,
      .parameters = parameters};
#ifdef SINGLE_PRECISION
  feclearexcept(FE_OVERFLOW | FE_UNDERFLOW);
#endif
  memcpy(&now, block, sizeof now);
  memcpy(parameters, block->parameters, sizeof(lanes) * P);
  memcpy(memory, block->memory, sizeof memory);
  prepare_iteration(&step, &data);
#ifdef HEAT_BATH
  block_bath bath;
  prepare_lanes(&bath, block, &now);
#endif
#ifdef OBSERVED
  observation seen;
  memcpy(&seen, block->observed, sizeof seen);
  observe(&seen, &now, block->t, parameters, block->active);
#endif
#ifdef TANGENTS
  tangent_growth growth;
  memcpy(&growth, block->growth, sizeof growth);
#endif
#ifdef MIXED_POINTS
  coordinates points[GROUPS];
  step.points = (double *)points;
#endif
  for (long long k = 0, stored = 0; k < steps; k++) {
#ifdef TRAJECTORIES_AS_LANES
    const history past = {memory[0], memory[1]};
#else
    const long long parity = block->step % 2;
    const history past = {memory[1 - parity], memory[parity]};
#endif
    step.t = block->t;
#ifdef HEAT_BATH
    const long long begun = report.iterations;
    enter_step(&bath, block, k, &now, memory[0]);
#endif
#ifdef DOUBLE_DOUBLE
    step.t_low = block->t_low, step.h_low = block->h_low;
#endif
#ifdef EXPLICIT_STEPS
    fixed_point(&step, &data, past, &block->guess, dq, dp, options ? options : &standard, &report);
#else
    const long long predicted = block->guess;
    memcpy(stored_results.active, block->active, sizeof stored_results.active);
    stored_results.repeated = 0;
    do {
      fixed_point(&step, &data, past, &block->guess, dq, dp, options ? options : &standard, &report);
#ifdef MIXED_POINTS
      refine_increments(&step, block->active, dq, dp);
#endif
    } while (memcmp(stored_results.active, block->active, sizeof stored_results.active) != 0 && predicted &&
        repeats_failed(&stored_results, past, &block->guess, dq, dp, block->active));
#endif
#ifdef HEAT_BATH
    if (!block->metropolis) /* which rejects them */
#endif
      drop_infinite(&now, dq, dp, block->step == 0, block->active);
#ifdef RUN_ACTION
    add_actions(block, &step, &data, past);
#endif
    add_increments(now.q, now.carry_q, dq, block->active);
    add_increments(now.p, now.carry_p, dp, block->active);
    block->step++;
    add_compensated(&block->t, &block->t_low, block->h, LOW_WORD(block, h));
#ifdef HEAT_BATH
    leave_step(&bath, block, k, step.t, report.iterations - begun, &now);
#endif
    for (int j = 0; j < count; j++)
      if (block->active[j] > 0.0)
        block->last_step[j] = block->step;
#ifdef OBSERVED
    observe(&seen, &now, block->t, parameters, block->active);
#endif
#ifdef TANGENTS
    const double passed = (double)block->step * fabs(block->h);
    add_growth(&growth, &now, past, passed, fabs(block->h));
#endif
    if (q && block->step % every == 0) {
#ifdef TANGENTS
      store_growth(&growth, passed, count, q + stored * row_length);
#else
      store_states(&now, count, q + stored * row_length, p + stored * row_length);
#endif
#ifdef RUN_ACTION
      store_actions(block, count, stored * (row_length / SAVED));
#endif
      stored++;
    }
  }
  block->iterations += report.iterations;
  memcpy(block, &now, sizeof now);
  memcpy(block->memory, memory, sizeof memory);
#ifdef OBSERVED
  memcpy(block->observed, &seen, sizeof seen);
#endif
#ifdef TANGENTS
  memcpy(block->growth, &growth, sizeof growth);
#endif
}

#ifdef OBSERVED
void NAME(observe)(block_memory *block, int lane, long long count, const double *t, const double *q, const double *p)
{
  state now;
  lanes parameters[P + 1];
  observation seen;
  double active[LANES] = {0.0};
  active[lane] = 1.0;
  memcpy(parameters, block->parameters, sizeof(lanes) * P);
  memcpy(&seen, block->observed, sizeof seen);
  for (long long k = 0; k < count; k++) {
    for (int i = 0; i < M; i++) {
      now.q[i] = lanes_of(q[k * M + i]);
      now.p[i] = lanes_of(p[k * M + i]);
    }
    observe(&seen, &now, t[k], parameters, active);
  }
  memcpy(block->observed, &seen, sizeof seen);
}
#endif

/* Puts the next trajectories into the lanes; surplus lanes repeat the last one and are inactive. */
static void begin_block(NAME(each) * c, int count)
{
  block_memory *block = c->block;
  NAME(start)(block, c->t, c->segment_h[0]);
#ifdef HEAT_BATH
  block->seed = c->seed, block->trajectory = c->trajectory + c->next, block->metropolis = c->metropolis;
#endif
#ifdef DOUBLE_DOUBLE
  block->t_low = c->t_low;
  set_step_to(c->segment_end[0], block->t, block->t_low, &block->h, &block->h_low);
#endif
  for (int j = 0; j < LANES; j++) {
    const long long from = c->next + (j < count ? j : count - 1);
    for (int i = 0; i < M; i++) {
      block->q[i][j] = (real)c->q[from * WORDS * M + i];
      block->p[i][j] = (real)c->p[from * WORDS * M + i];
#ifdef SINGLE_PRECISION
      block->carry_q[i][j] = (real)(c->q[from * M + i] - block->q[i][j]);
      block->carry_p[i][j] = (real)(c->p[from * M + i] - block->p[i][j]);
#endif
#ifdef DOUBLE_DOUBLE
      block->carry_q[i][j] = c->q[(from * WORDS + 1) * M + i];
      block->carry_p[i][j] = c->p[(from * WORDS + 1) * M + i];
#endif
    }
    block->active[j] = j < count;
  }
#ifdef TANGENTS
  for (int i = 0; i < (6 + TANGENTS) * TANGENTS; i++)
    for (int j = 0; j < LANES; j++)
      block->growth[i][j] = c->growth[i];
#endif
  c->rows = 1;
  c->segment = 0;
  c->left = c->segment_steps[0];
  c->entered = c->pauses;
}

long long NAME(call_each)(NAME(each) * c, long long steps)
{
  block_memory *block = c->block;
  long long taken = 0, failed = 0;
  c->entered = 0;
  while (c->next < c->end && taken < steps && !c->entered && !failed) {
    const int count = (int)(c->end - c->next < LANES ? c->end - c->next : LANES);
    if (c->segment < 0)
      begin_block(c, count);
    if (c->entered)
      break;
    for (int i = 0; i < P; i++)
      for (int j = 0; j < LANES; j++)
        block->parameters[i][j] = (real)c->parameters[(c->next + (j < count ? j : count - 1)) * P + i];
    const long long every = c->segment_every[c->segment], begun = block->step;
    const long long size = steps - taken < c->left ? steps - taken : c->left;
    const long long place = c->rows * c->trajectories + c->next;
#ifdef RUN_ACTION
    block->actions = c->actions ? c->actions + place : NULL;
#endif
    NAME(advance)(block, count, size, every, c->options, c->positions + place * SAVED,
        c->momenta ? c->momenta + place * SAVED : NULL, c->trajectories * SAVED);
    c->rows += block->step / every - begun / every;
    taken += size;
    c->left -= size;
    while (c->left == 0 && ++c->segment < c->segments) {
      c->left = c->segment_steps[c->segment];
#ifdef DRIVEN_FORCES
      block->guess = 0; /* the last force is that of the former inputs */
#endif
      block->guess = (real)c->segment_h[c->segment] == block->h ? block->guess : 0;
      block->h = (real)c->segment_h[c->segment];
#ifdef SINGLE_PRECISION
      block->h_low = (real)(c->segment_h[c->segment] - block->h);
#endif
#ifdef DOUBLE_DOUBLE
      set_step_to(c->segment_end[c->segment], block->t, block->t_low, &block->h, &block->h_low);
#endif
      c->entered = c->pauses;
    }
    int going = 0;
    for (int j = 0; j < count; j++)
      going |= block->active[j] != 0.0;
    if (!going) { /* all failed: nothing is left to do */
      c->segment = c->segments;
      c->entered = 0;
    }
#ifdef OBSERVED
    for (int i = 0; i < 5 * OBSERVED; i++)
      memcpy(c->observed + i * c->trajectories + c->next, block->observed[i / OBSERVED][i % OBSERVED],
          sizeof(double) * (size_t)count);
#endif
    for (int j = 0; j < count; j++) {
      c->done[c->next + j] = block->last_step[j];
      c->status[c->next + j] = block->active[j] == 0.0 ? STATUS(FAILED) : c->segment == c->segments ? STATUS(OK)
                                                                                                    : -1;
    }
    if (c->segment == c->segments) {
      for (int j = 0; j < count; j++)
        failed |= block->active[j] == 0.0;
      c->next += count;
      c->segment = -1;
    }
  }
  return taken;
}
