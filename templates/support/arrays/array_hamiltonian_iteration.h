#ifndef SUPPORT_ARRAY_HAMILTONIAN_ITERATION_H
#define SUPPORT_ARRAY_HAMILTONIAN_ITERATION_H

/* Fixed-point iteration of a step of an array Hamiltonian system: positions and momenta y at the points are updated
 * from their rates until they converge. Requires: points.h, convergence.h, the tables, curve_error.h, forces, which
 * computes the rates G at X: -H_q of the momenta, then H_p of the positions. Momenta follow positions in memory. */

/* Parts of work, by groups of points: y there, and rates in this step, the last one and the one before. */
typedef struct {
  lanes *X, *G, *last, *before;
} parts_of_work;

static parts_of_work divide(const run_memory *run, long long n)
{
  lanes *work = (lanes *)run->work, *derivatives_of_group[3];
  parts_of_work parts;
  for (int k = 0; k < 3; k++)
    derivatives_of_group[(k + run->turn) % 3] = work + (k + 1) * GROUPS * 2 * n;
  parts.X = work;
  parts.G = derivatives_of_group[0], parts.last = derivatives_of_group[1], parts.before = derivatives_of_group[2];
  return parts;
}

/* Extrapolates the rates from former steps, or sets them to 0. */
static void extrapolate_rates(const run_memory *run, const parts_of_work *parts, long long n,
    const struct predictor_tables_of *tables, long long guess)
{
  const long long apart = 2 * n;
  const section own = mine(run, n);
  for (int g = 0; g < GROUPS; g++)
    for (long long half = 0; half < apart; half += n)
      for (long long i = half + own.first; i < half + own.end; i++) {
        lanes derivative = lanes_of(0.0);
        if (guess == 1)
          derivative = contribution_of_points(tables->alone, g, &parts->last[i], apart);
        else if (guess > 1)
          derivative = contribution_of_points(tables->last, g, &parts->last[i], apart) +
              contribution_of_points(tables->before, g, &parts->before[i], apart);
        parts->G[g * apart + i] = derivative;
      }
}

/* Updates a block of y from index `first` on from its rates, by a table and weights; computes the sums of the squared
 * scaled changes, relative changes and scaled sizes, and the largest size. */
static void improve_block(const run_memory *run, lanes *X, const lanes *rates, const lanes *table,
    const lanes *weights, long long first, long long n, const measures *by_size, section here, double *total)
{
  const long long apart = 2 * n;
  lanes of_all = lanes_of(0.0), of_each = lanes_of(0.0);
  double size = 0.0, largest = 0.0;
  for (long long i = first + here.first; i < first + here.end; i++) {
    lanes kick[GROUPS], increment[GROUPS];
    double of_one, inverse;
    for (int g = 0; g < GROUPS; g++)
      kick[g] = run->h * weights[g] * rates[g * apart + i - first];
    for (int g = 0; g < GROUPS; g++)
      increment[g] = contribution_of_points(table, g, kick, 1);
    of_one = fabs(run->q[i]) + fabs(at_point(increment, 1, POINTS - 1));
    largest = larger(largest, of_one);
    of_one *= by_size->scale;
    size += of_one * of_one;
    inverse = inverse_size(of_one, by_size);
    for (int g = 0; g < GROUPS; g++) {
      const lanes y = run->q[i] + (run->carry_q[i] + increment[g]), moved = y - X[g * apart + i];
      const lanes scaled = by_size->scale * moved, relative = inverse * moved;
      of_all += scaled * scaled;
      of_each += relative * relative;
      X[g * apart + i] = y;
    }
  }
  total[0] = lanes_total(of_all), total[1] = lanes_total(of_each), total[2] = size, total[3] = largest;
}

/* Updates n elements; *largest is the largest size, on entry that of the previous iteration. */
static changes improve(const run_memory *run, lanes *X, const lanes *rates, const lanes *table, const lanes *weights,
    long long first, long long n, double *largest, const solver_options *options)
{
  const changes sudden = {1.0, 1.0};
  const measures by_size = measures_of(*largest);
  const double before = *largest;
  double total[4];
  sums all;
  begin_sums(&all, run, n);
  while (next_block(&all)) {
    improve_block(run, X, rates, table, weights, first, n, &by_size, all.here, total);
    add_values(&all, total, 4);
  }
  wait_at_barrier(run);
  for (int k = 0; k < 3; k++)
    total[k] = sum_of(&all, k);
  *largest = largest_of(&all, 3);
  return *largest > SUDDEN_GROWTH * before ? sudden : relative_changes(total, &by_size, n, options);
}

/* Returns 1 if all rates are finite. */
static int finite_rates(const run_memory *run, const lanes *G, long long n)
{
  sums all;
  begin_sums(&all, run, n);
  while (next_block(&all)) {
    lanes faults = lanes_of(0.0);
    for (int half = 0; half < 2 * GROUPS; half++)
      for (long long i = all.here.first; i < all.here.end; i++)
        faults += 0.0 * G[half * n + i];
    add_block(&all, lanes_total(faults), 0.0);
  }
  wait_at_barrier(run);
  return sum_of(&all, 0) == 0.0;
}

/* Approximate displacement of a coordinate in a step. */
static inline double moved_by(const run_memory *run, const lanes *velocity, long long n, long long i)
{
  return fabs(run->h * at_point(&velocity[i], 2 * n, KEPT / 2));
}

/* Largest sum of a coordinate and its displacement. */
static double largest_yet(const run_memory *run, const lanes *velocity, long long n)
{
  sums all;
  begin_sums(&all, run, n);
  while (next_block(&all)) {
    double largest = DBL_MIN;
    for (long long i = all.here.first; i < all.here.end; i++)
      largest = larger(largest, fabs(run->q[i]) + moved_by(run, velocity, n, i));
    add_block(&all, largest, 0.0);
  }
  wait_at_barrier(run);
  return largest_of(&all, 0);
}

/* Largest value of unresolved_part in a block for velocities, relative to the largest coordinate. */
static double unresolved_of_block(const run_memory *run, const lanes *velocity, long long n, double decay,
    double largest, section here)
{
  const double scale = scale_of(largest), unit = scale * run->h;
  double least = 0.0;
  for (long long i = here.first; i < here.end; i++) {
    const lanes *rate = &velocity[i];
    const double size = scale * (fabs(run->q[i]) + moved_by(run, velocity, n, i) + largest);
    const double start = at_point(rate, 2 * n, 0), middle = at_point(rate, 2 * n, KEPT / 2);
    const double ends = fabs(at_point(rate, 2 * n, KEPT - 1) - start) + fabs(middle - start);
    least = larger(least, unresolved_part(unit, top_coefficient(rate, 2 * n, decay), ends, size));
  }
  return least;
}

/* Error estimate of a step: the maximum over all blocks. */
static double unresolved(const run_memory *run, const lanes *velocity, long long n, double decay)
{
  const double largest = largest_yet(run, velocity, n);
  sums all;
  begin_sums(&all, run, n);
  while (next_block(&all))
    add_block(&all, unresolved_of_block(run, velocity, n, decay, largest, all.here), 0.0);
  wait_at_barrier(run);
  return largest_of(&all, 0);
}

/* Advances n elements from index `first` on to the end of the step. */
static void move(run_memory *run, const lanes *rates, const lanes *end, const lanes *weights, long long first,
    long long n)
{
  const section own = mine(run, n);
  for (long long i = first + own.first; i < first + own.end; i++) {
    lanes scaled[GROUPS];
    for (int g = 0; g < GROUPS; g++)
      scaled[g] = run->h * weights[g] * rates[g * 2 * n + i - first];
    add_compensated(&run->q[i], &run->carry_q[i], weigh_apart(end, scaled, 1), 0.0);
  }
}

/* Iterates until the points converge. Errors of positions become errors of momenta in one iteration and back in the
 * next, so that changes are judged in pairs. The tables extrapolate from *guess steps. On success *guess is the number
 * of steps for the next predictor, and *error the error estimate. */
static int solve(run_memory *run, const problem *given, long long n, const struct predictor_tables_of *tables,
    long long *guess, double decay, double *error, const solver_options *options, solver_report *report)
{
  const parts_of_work parts = divide(run, n);
  iteration now = new_iteration();
  double largest_q = 0.0, largest_p = 0.0;
  changes last = {0.0, 0.0};
  extrapolate_rates(run, &parts, n, tables, *guess);
  for (int k = 0; now.status == 0; k++) {
    const changes of_q = improve(run, parts.X, parts.G + n, POSITION, POSITION_WEIGHT, 0, n, &largest_q, options);
    const changes of_p = improve(run, parts.X, parts.G, MOMENTUM, MOMENTUM_WEIGHT, n, n, &largest_p, options);
    const changes both = {of_q.of_all + of_p.of_all, of_q.of_each + of_p.of_each};
    const changes pair = {last.of_all + both.of_all, last.of_each + both.of_each};
    forces(run, given, parts.X, 2 * n, parts.G, 2 * n);
    if (k > 0 && k % 2 == 0)
      record_change(&now, pair, options, report);
    last = both;
  }
  if (now.status < 0)
    return failure_of(&now);
  if (!finite_rates(run, parts.G, n))
    return NOT_FINITE;
  *error = unresolved(run, parts.G + n, n, decay);
  *guess = steps_to_continue(*guess, now.first);
  return OK;
}

/* Advances the state to the end of the solved step. */
static void continue_steps(run_memory *run, long long n)
{
  const lanes *G = divide(run, n).G;
  move(run, G + n, POINT_END_POSITION, POSITION_WEIGHT, 0, n);
  move(run, G, POINT_END_MOMENTUM, MOMENTUM_WEIGHT, n, n);
}

#endif
