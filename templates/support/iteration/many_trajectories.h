#include "../core/trajectories.h"
#include "../core/stagnation.h"

/* Fixed-point iteration of many trajectories, which are SIMD lanes: predictor and termination. A step fails for single
 * trajectories, which become inactive, never for all. Requires: the tables LAST_ALONE, LAST, BEFORE, which extrapolate
 * stored values into the next step. */

/* The second curve of stored values. */
static inline history second_curve(history past)
{
  const history second = {past.last + S, past.before + S};
  return second;
}

/* Memory for the values to be stored. */
#define kept(past, own) ((void)(own), (past).before)

/* Number of former steps that the predictor uses: 0 for all trajectories, or 1, to which 2^(j + 1) is added if it is 2
 * for trajectory j. */
#define TWO_STEPS ((2LL << LANES) - 1) /* for all */

/* Extrapolates the stored values of some trajectories from the last step, of others from the last two. */
static __attribute__((noinline)) void continue_differently(history past, long long steps, lanes (*x)[M])
{
  lane_view one;
  for (int j = 0; j < LANES; j++)
    one.lane[j] = steps & 2LL << j ? 0.0 : 1.0;
  for (int i = 0; i < M; i++) {
    lanes next[S];
    for (int n = 0; n < S; n++)
      next[n] = lanes_selected(
          one.all, sum_of_stored(LAST_ALONE, n, past.last, i),
          sum_of_stored(LAST, n, past.last, i) + sum_of_stored(BEFORE, n, x, i));
    for (int n = 0; n < S; n++)
      x[n][i] = next[n];
  }
}

/* Extrapolates the stored values into this step from the last one or from the last two. */
static inline void continue_curve(const step_data *step, history past, long long steps, lanes (*x)[M])
{
  if (steps != 1 && steps != TWO_STEPS) {
    continue_differently(past, steps, x);
    return;
  }
  for (int i = 0; i < M; i++) {
    lanes next[S];
    for (int n = 0; n < S; n++)
      next[n] = steps == 1 ? sum_of_stored(LAST_ALONE, n, past.last, i)
                           : sum_of_stored(LAST, n, past.last, i) + sum_of_stored(BEFORE, n, x, i);
    for (int n = 0; n < S; n++)
      x[n][i] = next[n];
  }
}

#define remember_curve(x, past) (void)0 /* computed in place (kept) */

/* Velocities of the straight line; they are stored before the first step. */
#define start_velocities(step, z) OK

/* Progress of the iteration of a step in every lane, as trajectory_progress. status: 1 converged, 0 undecided, -1
 * failed in this iteration, -2 before; amplification: factor of the last change to be added, AMPLIFICATION or 0;
 * converged: their number; stored, stored_count: those whose values have been stored. */
typedef struct {
  lanes first, last, before, earlier, amplified, since, status, amplification, by_largest, stagnant;
  lanes stored;
  int pending, converged, stored_count;
} progress;

static inline progress before_iterations(void)
{
  const lanes none = lanes_of(INFINITY);
  const progress now = {.last = none, .before = none, .earlier = none, .pending = 1};
  return now;
}

#define needs_iteration(now) ((now)->pending)

/* Each trajectory has the status of the first iteration that decided it; others may require more iterations. Changes at
 * the level of rounding are random: those of many trajectories rarely meet the criterion in the same iteration. */
static inline void take_change(progress *now, lanes change, const solver_options *options, int k, solver_report *report)
{
  const lane_view after = {change}, last = {now->last}, before = {now->before};
  lane_view status = {now->status}, active;
  const solver_options wanted = *options; /* a copy, which cannot alias what is written */
  int pending = 0, converged = 0;
  memcpy(active.lane, report->active, sizeof active);
  for (int j = 0; j < LANES; j++) {
    const double found = iteration_status(after.lane[j], last.lane[j], before.lane[j], &wanted, k, FINAL_ITERATIONS);
    const double first = active.lane[j] > 0.0 ? found : -2.0;
    status.lane[j] = status.lane[j] == 0.0 ? first : status.lane[j];
    pending += status.lane[j] == 0.0;
    converged += status.lane[j] == 1.0;
  }
  now->status = status.all;
  now->pending = pending > 0;
  now->converged = converged;
  now->first = k == 0 ? change : now->first;
  now->earlier = now->before;
  now->before = now->last;
  now->last = change;
  report->iterations++;
}

/* 1 where the iteration continues and its last change exceeds a level. */
static inline number undecided(const progress *now, double level)
{
  const lane_view last = {now->last};
  lane_view status = {now->status};
  for (int j = 0; j < LANES; j++)
    status.lane[j] = status.lane[j] == 0.0 && last.lane[j] > level ? 1.0 : 0.0;
  return status.all;
}

/* 1 where the stiffness is measured in iteration k: in the second, and in some of many. */
static inline number measures_stiffness(const progress *now, int k)
{
  return number_of(k == 1 || k % 8 == 5) * undecided(now, NO_REMAINDER);
}

/* The last iteration does not show the stiffness: the points of trajectories that converged before others are lost. */
#define has_remainder(now, options) 0

static inline int any_positive(number x)
{
  const lane_view view = {x};
  int any = 0;
  for (int j = 0; j < LANES; j++)
    any |= view.lane[j] > 0.0;
  return any;
}

/* Decides about the lanes that have not converged, by is_to_amplify if `amplifies`, else by is_one_stagnant; returns 1
 * if that holds in one of them. */
static SELDOM int decide_lanes(progress *now, const solver_options *options, int k, int amplifies)
{
  lane_view last = {now->last}, before = {now->before}, earlier = {now->earlier}, amplified = {now->amplified};
  lane_view since = {now->since}, status = {now->status}, by_largest = {now->by_largest}, holds = {lanes_of(0.0)};
  int any = 0, pending = 0;
  for (int j = 0; j < LANES; j++)
    if (status.lane[j] == 0.0 || status.lane[j] == -1.0) {
      trajectory_progress seen = {0.0, last.lane[j], before.lane[j], earlier.lane[j], amplified.lane[j],
          (int)status.lane[j], (int)since.lane[j], by_largest.lane[j] > 0.0, 0};
      holds.lane[j] = amplifies ? is_to_amplify(&seen, options, k) : is_one_stagnant(&seen, options, k);
      any |= holds.lane[j] > 0.0;
      last.lane[j] = seen.last, before.lane[j] = seen.before, earlier.lane[j] = seen.earlier;
      amplified.lane[j] = seen.amplified, since.lane[j] = seen.since, by_largest.lane[j] = seen.by_largest;
      status.lane[j] = amplifies && seen.status < 0 ? -2.0 : seen.status;
      now->converged += seen.status == 1;
      pending |= seen.status == 0;
    }
  now->pending = amplifies ? pending : now->pending | any;
  now->last = last.all, now->before = before.all, now->earlier = earlier.all, now->amplified = amplified.all;
  now->since = since.all, now->status = status.all, now->by_largest = by_largest.all;
  if (amplifies)
    now->amplification = AMPLIFICATION * holds.all;
  else
    now->stagnant = holds.all;
  return any;
}

/* The same if a condition holds in some of them; `now` may stay in registers. */
static inline int decide_if(int condition, progress *now, const solver_options *options, int k, int amplifies)
{
  if (k <= 1 || !condition)
    return 0;
  progress seen = *now;
  const int any = decide_lanes(&seen, options, k, amplifies);
  *now = seen;
  return any;
}

static inline int is_stagnant(progress *now, const solver_options *options, int k)
{
  const lane_view last = {now->last}, before = {now->before}, earlier = {now->earlier}, status = {now->status};
  int stagnates = 0;
  for (int j = 0; j < LANES; j++)
    stagnates |= (status.lane[j] == -1.0) |
        ((status.lane[j] == 0.0) & (last.lane[j] > STAGNANT * before.lane[j]) &
            (last.lane[j] > STAGNATION * earlier.lane[j]));
  return decide_if(stagnates, now, options, k, 0);
}

#define stagnant(now) ((now)->stagnant) /* where is_stagnant returned 1 */

static inline int must_amplify(progress *now, const solver_options *options, int k)
{
  const lane_view status = {now->status};
  int undecided = 0;
  for (int j = 0; j < LANES; j++)
    undecided |= (status.lane[j] == 0.0) | (status.lane[j] == -1.0);
  return decide_if(undecided, now, options, k, 1);
}

#define amplification(now) ((now)->amplification)

/* Returns 1 if the values of trajectories have to be stored, which have converged before others. */
static inline int converge_early(const progress *now)
{
  return now->pending && now->converged > now->stored_count;
}

/* Stores the values of the trajectories that have converged. */
static inline void store_early(const progress *now, const lanes *x, lanes *stored)
{
  for (int i = 0; i < S * M; i++)
    stored[i] = now->stored_count ? lanes_selected(now->stored, stored[i], x[i]) : x[i];
}

/* After the values of trajectories have been stored. */
static inline void mark_stored(progress *now)
{
  const lane_view status = {now->status};
  lane_view stored;
  for (int j = 0; j < LANES; j++)
    stored.lane[j] = status.lane[j] == 1.0;
  now->stored = stored.all;
  now->stored_count = now->converged;
}

/* Replaces the values of trajectories that converged before others, whose iterations changed them. */
static inline void restore_early(const progress *now, const lanes *stored, lanes *x)
{
  if (now->stored_count)
    for (int i = 0; i < S * M; i++)
      x[i] = lanes_selected(now->stored, stored[i], x[i]);
}

/* Trajectories that converge too slowly or left the domain become inactive. */
static inline int outcome(const progress *now, const solver_report *report)
{
  const lane_view status = {now->status};
  for (int j = 0; j < LANES; j++)
    report->active[j] = status.lane[j] < 0.0 ? 0.0 : report->active[j];
  return OK;
}

#define accept(step, dq, dp) OK

static inline long long next_guess(long long steps, const progress *now, const solver_report *report)
{
  const lane_view first = {now->first};
  long long two = 0;
  for (int j = 0; j < LANES; j++)
    two += first.lane[j] < GOOD_GUESS || !(report->active[j] > 0.0) ? 2LL << j : 0;
  return steps > 0 ? 1 | two : 1;
}
