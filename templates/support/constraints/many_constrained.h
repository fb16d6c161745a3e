#include "multiplier_sizes.h"

/* Constrained steps of trajectories that are SIMD lanes. Each is accepted in the iteration in which it would be alone.
 * A trajectory that needs more than the iteration, wider sizes or Newton's method, fails: it is continued alone from
 * its last state. Requires: the table END_POSITION; N unknowns of a step. */
enum { SOLUTION_VECTORS = __builtin_offsetof(rattle_step, g) / sizeof(lanes) };

typedef rattle_data iteration_data;

#define prepare_iteration prepare_rattle

/* Verdict of `accepts` in each lane: 1, 0 or -1. */
static inline lanes verdicts(const lanes *change, const lanes *overall, const solver_options *options, int k)
{
  const solver_options of = *options; /* a copy, which cannot alias what is written */
  lane_view verdict, made[3], all[3];
  memcpy(made, change, sizeof made);
  memcpy(all, overall, sizeof all);
  for (int j = 0; j < LANES; j++) {
    const real changes[] = {made[0].lane[j], made[1].lane[j], made[2].lane[j]};
    const real overalls[] = {all[0].lane[j], all[1].lane[j], all[2].lane[j]};
    verdict.lane[j] = accepts(changes, overalls, &of, k);
  }
  return verdict.all;
}

/* Copies the solution in these lanes. */
static inline void copy_lanes(condition which, const rattle_step *from, rattle_step *to)
{
  const lanes *y = (const lanes *)from;
  lanes *x = (lanes *)to;
  for (int n = 0; n < SOLUTION_VECTORS; n++)
    x[n] = where(which, y[n], x[n]);
}

/* Lanes that an accepted iteration may have cost digits fail if it did; the verdict of others is by the sizes of their
 * reactions. */
static SELDOM __attribute__((noinline)) void check_digits(const step_data *step, rattle_step *now, condition may,
    const lanes *change, const solver_options *options, int k, lanes *made, lanes *overall, unknown_sizes *sizes,
    lanes *verdict)
{
  unknown_sizes seen;
  const condition loses = may & loses_digits(step, now, &seen);
  const condition again = may & ~loses & (condition)(*verdict > 0.0);
  if (!options->absolute && any_of(again)) {
    const movement moved = measure_change(change, seen.inverse, seen.largest);
    for (int i = 0; i < M; i++)
      sizes->inverse[i] = where(again, seen.inverse[i], sizes->inverse[i]);
    sizes->largest = where(again, seen.largest, sizes->largest);
    made[0] = where(again, moved.relative, made[0]);
    overall[0] = where(again, moved.overall, overall[0]);
    *verdict = where(again, verdicts(made, overall, options, k), *verdict);
  }
  *verdict = where(loses, lanes_of(-1.0), *verdict);
}

/* Solves g(u) = 0 for lambda and u in the lanes `begun`; returns those in which it is solved. */
static condition solve_constraints(const step_data *step, rattle_step *now, condition begun,
    const solver_options *options, solver_report *report)
{
  factors l[GROUPS] = {{{0.0}}};
  lanes change[M * GROUPS], made[3], overall[3];
  rattle_step early;
  unknown_sizes sizes;
  condition pending = begun, solved = {0}, copied = {0}, factorised = ~begun;
  for (int n = 0; n < 3; n++)
    made[n] = overall[n] = lanes_of(INFINITY);
  for (int k = 0; k < options->max_iterations && any_of(pending); k++) {
    movement moved;
    lanes verdict;
    condition may;
    iterate(step, now, l, factorised, (lanes(*)[GROUPS])change);
    if (k == 0)
      find_sizes(step, now, &sizes);
    moved = measure_change(change, sizes.inverse, sizes.largest);
    report->iterations++;
    made[0] = options->absolute ? moved.absolute : moved.relative;
    overall[0] = moved.overall;
    evaluate_points(step, now);
    verdict = verdicts(made, overall, options, k);
    may = pending & may_lose_digits(step, now, sizes.inverse);
    if (k != MULTIPLIERS_KNOWN)
      may &= (condition)(verdict > 0.0);
    if (any_of(may))
      check_digits(step, now, may, change, options, k, made, overall, &sizes, &verdict);
    solved |= pending & (condition)(verdict > 0.0);
    pending &= (condition)(verdict == 0.0);
    if (any_of(pending) && any_of(solved & ~copied)) {
      copy_lanes(solved & ~copied, now, &early);
      copied = solved;
    }
    factorised = ~pending | (condition)(overall[0] < REUSED_FACTORS);
    for (int n = 2; n > 0; n--)
      made[n] = made[n - 1], overall[n] = overall[n - 1];
  }
  if (any_of(copied))
    copy_lanes(copied, &early, now);
  return solved;
}

/* Increments of one step of each trajectory. `past` contains the unknowns of the last step, before the first step the
 * velocities if masses depend on positions. */
static void fixed_point(const step_data *step, const iteration_data *data, history past, long long *guess, lanes *dq,
    lanes *dp, const solver_options *options, solver_report *report)
{
  rattle_step now;
  lanes z[N], active, finite = {0.0}, *memory = past.last[0];
  condition solved;
  memcpy(&active, report->active, sizeof active);
  begin(step, data, *guess ? memory : NULL, memory, &now);
  solved = solve_constraints(step, &now, (condition)(active > 0.0), options, report);
  finish_step(step, &now, z, dp);
  for (int n = 0; n < N; n++)
    finite += 0.0 * z[n];
  solved &= (condition)(finite == 0.0);
  for (int i = 0; i < M; i++) {
    lanes sum = {0.0};
    for (int b = 0; b < B; b++)
      sum += END_POSITION[b] * z[i * B + b];
    dq[i] = step->h * sum;
  }
  for (int n = 0; n < N; n++)
    memory[n] = where(solved, z[n], memory[n]);
  active = where(solved, active, lanes_of(0.0));
  memcpy(report->active, &active, sizeof active);
  *guess = 1;
}
