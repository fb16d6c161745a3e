#ifndef SUPPORT_ARRAY_POINTS_H
#define SUPPORT_ARRAY_POINTS_H

/* Step of arrays with constant diagonal masses: the iteration of separable_iteration.h with norms over all coordinates,
 * which are shared by threads in blocks. Requires: separable_iteration.h, array_convergence.h, forces, curve_error.h.
 * Include before solve, by fixed-point iteration or Newton's method. */

/* Arguments, constants and arrays of a step. */
typedef struct {
  step_data step;
  iteration_data data;
  step_points points;
} array_step;

/* Divides the work: the points, then forces of this step, the last one and the one before, in turn. */
static void begin_step(const run_memory *run, const problem *given, long long n, array_step *all)
{
  lanes *work = (lanes *)run->work, *F[3];
  const step_data step = {run->t, run->h, run->q, run->p, run->carry_q, run->carry_p};
  for (int k = 0; k < 3; k++)
    F[(k + run->turn) % 3] = work + (k + OF_EACH) * GROUPS * n;
  all->step = step;
  all->data.inverse_mass = run->inverse_mass;
  prepare_step_size(run->h, &all->data);
  const step_points points = {&all->step, &all->data, work, F[0], n, run, given, F[1], F[2], 1.0};
  all->points = points;
}

static void forces_at_points(const step_points *w)
{
  forces(w->run, w->given, w->X, OF_EACH * w->n, w->F, w->n);
}

/* Initial points of a block, with forces extrapolated from former steps or without any; returns the largest sum of a
 * coordinate and its drift. */
static double first_of_block(const step_points *w, const struct predictor_tables_of *tables, long long guess,
    section here)
{
  const long long n = w->n;
  double largest = DBL_MIN;
  for (long long i = here.first; i < here.end; i++) {
    const drift_words of = find_drift(w, i);
    for (int g = 0; g < GROUPS; g++) {
      lanes curvature = lanes_of(0.0);
      if (guess == 1)
        curvature = contribution_of_points(tables->alone, g, &w->last[i], n);
      else if (guess > 1)
        curvature = contribution_of_points(tables->last, g, &w->last[i], n) +
            contribution_of_points(tables->before, g, &w->before[i], n);
      if (VELOCITIES) /* the extrapolation is of forces, from which velocities follow, too */
        w->F[g * n + i] = curvature;
      w->X[g * OF_EACH * n + i] = STRAIGHT(w, g, i, of);
      if (!VELOCITIES && guess > 0)
        w->X[g * OF_EACH * n + i] += unit_of(w, i) * curvature;
    }
    for (int g = 0; VELOCITIES && g < GROUPS; g++)
      w->X[g * OF_EACH * n + i] += unit_of(w, i) * SUM_OF_FORCES(PRODUCT, w, g, i);
    largest = larger(largest, fabs(w->step->q0[i]) + fabs(of.high));
  }
  return largest;
}

/* Computes the initial points (first_of_block); returns the largest value. */
static double first_points(const step_points *w, const struct predictor_tables_of *tables, long long guess)
{
  sums all;
  begin_sums(&all, w->run, w->n);
  while (next_block(&all))
    add_block(&all, first_of_block(w, tables, guess, all.here), 0.0);
  wait_at_barrier(w->run);
  return largest_of(&all, 0);
}

/* Sum of the forces at the first and the last point, without signs. */
static inline double ends_of_forces(const step_points *w, long long i)
{
  return fabs(at_first(&w->F[i])) + fabs(at_point(&w->F[i], w->n, KEPT - 1));
}

/* Returns the largest coordinate. If squares of it would overflow or underflow, it includes the displacements by the
 * forces at the first and the last point: the only size available in a step from rest at 0. */
static double largest_moved(const step_points *w, double largest)
{
  sums all;
  if (scale_of(largest) == 1.0)
    return largest;
  begin_sums(&all, w->run, w->n);
  while (next_block(&all)) {
    double of_block = largest;
    for (long long i = all.here.first; i < all.here.end; i++)
      of_block = larger(of_block, unit_of(w, i) * ends_of_forces(w, i));
    add_block(&all, of_block, 0.0);
  }
  wait_at_barrier(w->run);
  return largest_of(&all, 0);
}

/* Error estimate of a block: the largest value of unresolved_part for forces, relative to the largest coordinate. NaN
 * if a force is not finite. */
static double unresolved(const step_points *w, double largest, double decay, section here)
{
  const double scale = scale_of(largest);
  lanes faults = lanes_of(0.0);
  double least = 0.0;
  for (long long i = here.first; i < here.end; i++) {
    const double unit = scale * unit_of(w, i);
    const double moved = w->step->h * w->data->inverse_mass[i] * w->step->p0[i];
    const double size = scale * (fabs(w->step->q0[i]) + fabs(moved) + largest);
    const double top = top_coefficient(&w->F[i], w->n, decay);
    for (int g = 0; g < GROUPS; g++)
      faults += 0.0 * w->F[g * w->n + i];
    least = larger(least, unresolved_part(unit, top, ends_of_forces(w, i), size));
  }
  return least + lanes_total(faults);
}

/* Returns 1 if all forces are finite; *error is the error estimate over all blocks. */
static int examine(const step_points *w, double largest, double decay, double *error)
{
  sums all;
  begin_sums(&all, w->run, w->n);
  while (next_block(&all)) {
    const double found = unresolved(w, largest, decay, all.here);
    add_block(&all, found, found == found ? 0.0 : 1.0);
  }
  wait_at_barrier(w->run);
  *error = largest_of(&all, 0);
  return sum_of(&all, 1) == 0.0;
}

/* Advances the state to the end of the solved step. */
static void continue_steps(run_memory *run, long long n)
{
  const section own = mine(run, n);
  array_step all;
  begin_step(run, NULL, n, &all);
  for (long long i = own.first; i < own.end; i++) {
    const end_increments end = increments_of(&all.points, i);
    add_compensated(&run->q[i], &run->carry_q[i], end.q, end.q_low);
    add_compensated(&run->p[i], &run->carry_p[i], end.p, 0.0);
  }
}

#endif
