#include "../core/trajectories.h"

/* Ensemble runs on a GPU: a thread advances one trajectory. Trajectories do not affect each other. One whose step fails
 * stops before it, and the processor continues it. Stored values change places by copies, so that all arrays may stay
 * in registers. Requires: ensemble_run.h, KERNEL, and TRAJECTORY, the number of the thread. */

/* Memory of a thread between calls. head: the time, its low word, the steps for the predictor, and 1 while active. */
typedef struct {
  lanes head[4];
  state now;
  lanes last[STORED][M], before[STORED][M];
#ifdef OBSERVED
  observation seen;
#endif
} thread_memory;

/* Reads or writes numbers of a trajectory, which are `count` numbers apart in global memory. */
static inline double *transfer(int writes, lanes *x, int size, double *memory, long long count)
{
  for (int i = 0; i < size; i++)
    if (writes)
      memory[i * count] = x[i];
    else
      x[i] = memory[i * count];
  return memory + size * count;
}

static inline void transfer_all(int writes, thread_memory *own, double *memory, long long count)
{
  memory = transfer(writes, own->head, 4, memory, count);
  memory = transfer(writes, own->now.q, M, memory, count);
  memory = transfer(writes, own->now.p, M, memory, count);
  memory = transfer(writes, own->now.carry_q, M, memory, count);
  memory = transfer(writes, own->now.carry_p, M, memory, count);
  memory = transfer(writes, &own->last[0][0], STORED * M, memory, count);
  memory = transfer(writes, &own->before[0][0], STORED * M, memory, count);
#ifdef OBSERVED
  transfer(writes, own->seen.last, 5 * OBSERVED, memory, count);
#endif
}

/* Prepares the repetition of a failed step from the value at the beginning of the extrapolated curve, as in
 * ensemble_run.h; returns 0 if there is no such curve. */
static inline int starts_again(thread_memory *own, long long *guess, long long step)
{
#ifdef EXPLICIT_STEPS
  return 0;
#else
  for (int n = 0; n < S; n++)
    for (int i = 0; i < M; i++)
      own->before[n][i] = apply(LAST_ALONE, 0, own->last, i);
  *guess = 0;
  return step > 0;
#endif
}

/* Advances `count` trajectories from step number `begin`. memory: (4 + 4 M + 2 STORED M, count) numbers, and 5 OBSERVED
 * more; parameters: (count, P). Every `every` steps counted from the start states are stored in rows of (count, M)
 * numbers. done: the numbers of completed steps. */
KERNEL NAME(thread_advance)(long long count, long long begin, long long steps, long long every, double h,
    double tolerance, long long max_iterations, long long absolute, double *memory, const double *parameters, double *q,
    double *p, long long *done)
{
  const long long k = TRAJECTORY;
  const solver_options options = {tolerance, (int)max_iterations, (int)absolute};
  thread_memory own;
  iteration_data data;
  lanes values[P + 1], dq[2 * M], dp[2 * M]; /* increments, then their low words */
  double active = 1.0;
  solver_report report = {&active, 0};
  step_data step = {0.0, h, own.now.q, own.now.p, own.now.carry_q, own.now.carry_p, values};
  long long guess, n = begin;
  if (k >= count)
    return;
  transfer_all(0, &own, memory + k, count);
  if (!(own.head[3] > 0.0))
    return;
  for (int i = 0; i < P; i++)
    values[i] = parameters[k * P + i];
  for (int i = 0; i < 2 * M; i++)
    dq[i] = dp[i] = 0.0;
  q += k * M;
  p += k * M;
  step.t = own.head[0];
  guess = (long long)own.head[2];
  prepare_iteration(&step, &data);
#ifdef OBSERVED
  observe(&own.seen, &own.now, step.t, values, &active);
#endif
  for (; n < begin + steps; n++) {
    const history past = {own.last, own.before};
    int repeated = 0;
    do {
      active = 1.0;
      fixed_point(&step, &data, past, &guess, dq, dp, &options, &report);
    } while (!(active > 0.0) && !repeated++ && starts_again(&own, &guess, n));
    drop_infinite(&own.now, dq, dp, 0, &active);
    if (!(active > 0.0))
      break;
    add_increments(own.now.q, own.now.carry_q, dq, &active);
    add_increments(own.now.p, own.now.carry_p, dp, &active);
    for (int point = 0; point < STORED; point++)
      for (int i = 0; i < M; i++) {
        const lanes earlier = own.last[point][i];
        own.last[point][i] = own.before[point][i];
        own.before[point][i] = earlier;
      }
    add_compensated(&step.t, &own.head[1], h, 0.0);
#ifdef OBSERVED
    observe(&own.seen, &own.now, step.t, values, &active);
#endif
    if ((n + 1) % every == 0) {
      for (int i = 0; i < M; i++) {
        q[i] = own.now.q[i];
        p[i] = own.now.p[i];
      }
      q += count * M;
      p += count * M;
    }
  }
  done[k] = n;
  own.head[0] = step.t;
  own.head[2] = (double)guess;
  own.head[3] = active;
  transfer_all(1, &own, memory + k, count);
}

/* Replaces states of trajectories that the processor has continued: values, (rows, number, M), are stored in the
 * columns `which` of target, (rows, count, M), unless they are NaN. */
KERNEL NAME(thread_replace)(long long count, long long rows, long long number, const long long *which,
    const double *values, double *target)
{
  const long long k = TRAJECTORY;
  if (k >= rows * number)
    return;
  for (int i = 0; i < M; i++)
    if (values[k * M + i] == values[k * M + i])
      target[(k / number * count + which[k % number]) * M + i] = values[k * M + i];
}
