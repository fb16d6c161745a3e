#ifndef SUPPORT_ARRAY_ITERATION_H
#define SUPPORT_ARRAY_ITERATION_H

/* Fixed-point iteration of a step of arrays. Requires: array_points.h. */

/* Updates all points from the forces; returns the sum of the squared scaled changes. *size, if it is not NULL, is that
 * of the sizes of the coordinates. */
static double improve(const step_points *w, double *size)
{
  sums all;
  begin_sums(&all, w->run, w->n);
  while (next_block(&all)) {
    double of_block = 0.0;
    const double change = lanes_total(improve_points(w, all.here, size ? &of_block : NULL));
    add_block(&all, change, of_block);
  }
  wait_at_barrier(w->run);
  if (size)
    *size = sum_of(&all, 1);
  return sum_of(&all, 0);
}

#if VELOCITIES
/* Updates the velocities at the points from the forces; returns the sum of the squared scaled changes times h. */
static double improve_velocities(const step_points *w)
{
  const step_data *step = w->step;
  sums all;
  begin_sums(&all, w->run, w->n);
  while (next_block(&all)) {
    lanes total = lanes_of(0.0);
    for (int g = 0; g < GROUPS; g++) {
      lanes *V = w->X + (g * OF_EACH + 1) * w->n;
      for (long long i = all.here.first; i < all.here.end; i++) {
        const lanes kick = step->carry_p[i] + step->h * SUM_OF_FORCES(VELOCITY, w, g, i);
        const lanes v = w->data->inverse_mass[i] * (step->p0[i] + kick), moved = w->scale * step->h * (v - V[i]);
        total += moved * moved;
        V[i] = v;
      }
    }
    add_block(&all, lanes_total(total), 0.0);
  }
  wait_at_barrier(w->run);
  return sum_of(&all, 0);
}
#else
static double improve_velocities(const step_points *w)
{
  (void)w;
  return 0.0;
}
#endif

/* Computes the points of a block with double-double coefficients and, if `measured`, the sums of the squared scaled and
 * relative changes. */
static void last_of_block(const step_points *w, const measures *by_size, int measured, section here, double *total)
{
  lanes of_all = lanes_of(0.0), of_each = lanes_of(0.0);
  for (long long i = here.first; i < here.end; i++) {
    const drift_words of = find_drift(w, i);
    lanes X[GROUPS];
    for (int g = 0; g < GROUPS; g++)
      X[g] = accurate_point(w, g, of, i);
    if (measured) {
      const double size = by_size->scale * size_of(w, of, i);
      for (int g = 0; g < GROUPS; g++) {
        const lanes moved = X[g] - w->X[g * OF_EACH * w->n + i];
        const lanes scaled = by_size->scale * moved, relative = inverse_size(size, by_size) * moved;
        of_all += scaled * scaled;
        of_each += relative * relative;
      }
    }
    for (int g = 0; g < GROUPS; g++)
      w->X[g * OF_EACH * w->n + i] = X[g];
  }
  total[0] = lanes_total(of_all), total[1] = lanes_total(of_each);
}

/* Iteration with double-double coefficients; returns the changes if `measured`. */
static changes last_iteration(const step_points *w, const measures *by_size, int measured, double size,
    const solver_options *options)
{
  double total[3] = {0.0, 0.0, size};
  sums all;
  begin_sums(&all, w->run, w->n);
  while (next_block(&all)) {
    double of_block[2];
    last_of_block(w, by_size, measured, all.here, of_block);
    add_values(&all, of_block, 2);
  }
  wait_at_barrier(w->run);
  total[0] = sum_of(&all, 0), total[1] = sum_of(&all, 1);
  improve_velocities(w);
  forces_at_points(w);
  return relative_changes(total, by_size, w->n, options);
}

/* Iterates until the state converges, then once more with double-double coefficients; where small coordinates converge
 * later, until they do. The tables extrapolate from *guess steps. On success *guess is the number of steps for the next
 * predictor, and *error the error estimate. */
static int solve(run_memory *run, const problem *given, long long n, const struct predictor_tables_of *tables,
    long long *guess, double decay, double *error, const solver_options *options, solver_report *report)
{
  const int measured = run->step % MEASURED == 0 || run->uneven;
  iteration now = new_iteration(), small = new_iteration();
  array_step step;
  step_points *w = &step.points;
  double largest, total[3] = {0.0};
  changes last;
  measures by_size;
  begin_step(run, given, n, &step);
  largest = first_points(w, tables, *guess);
  improve_velocities(w);
  forces_at_points(w);
  largest = largest_moved(w, largest);
  by_size = measures_of(largest);
  w->scale = by_size.scale;
  while (now.status == 0) {
    total[0] = improve(w, now.count == 0 ? &total[2] : NULL);
    total[0] += improve_velocities(w);
    forces_at_points(w);
    record_change(&now, relative_changes(total, &by_size, n, options), options, report);
  }
  if (now.status < 0)
    return failure_of(&now);
  *guess = steps_to_continue(*guess, now.first);
  last = last_iteration(w, &by_size, measured, total[2], options);
  while (is_unsettled(&small, &last, options)) {
    small.before = small.last, small.last = last;
    small.count++;
    last = last_iteration(w, &by_size, 1, total[2], options);
  }
  if (small.count > 0)
    last_iteration(w, &by_size, 0, total[2], options);
  if (measured)
    run->uneven = small.count > 1 || (small.count > 0 && last.of_each < STAGNATION * small.last.of_each);
  report->iterations += small.count + (small.count > 0);
  return examine(w, largest, decay, error) ? OK : NOT_FINITE;
}

#endif
