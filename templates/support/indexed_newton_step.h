/* Newton's method for the points of a step of an indexed system. Requires: indexed_newton.h, gmres.h. */

#define REFRESHED 1e-6 /* squared: the preconditioner is recomputed while points change by more than 1e-3 of the
                        * state */
#define UNSOLVED 1e-10 /* relative to the state: a larger residual is not due to rounding */

/* Parts of work behind those of the fixed-point iteration. */
static linear_system linear_of(const step_points *points)
{
  const long long count = GROUPS * points->n;
  lanes *work = (lanes *)points->run->work + ITERATION_VECTORS * count;
  const linear_system of = {.run = points->run,
      .given = points->given,
      .points = points,
      .n = points->n,
      .count = count,
      .own = mine(points->run, points->n),
      .residual = work,
      .correction = work + count,
      .product = work + 2 * count,
      .forces = work + 3 * count,
      .inverse = work + 4 * count,
      .spare = work + (4 + POINTS) * count,
      .basis = work + (4 + POINTS + SPARE_VECTORS) * count,
      .roots = (double *)(work + (4 + POINTS + SPARE_VECTORS + BASIS + 1) * count)};
  return of;
}

/* Residual: the change by one fixed-point iteration at the points with their forces, for the coordinates of this
 * thread. */
static void find_residual(linear_system *of, const step_points *w)
{
  for (long long i = of->own.first; i < of->own.end; i++) {
    const drift along = find_drift(w, i);
    const double q = w->step->q0[i];
    for (int g = 0; g < GROUPS; g++) {
      const lanes sum = SUM_OF_FORCES(PRODUCT, w, g, i) + SUM_OF_FORCES(PRODUCT_LOW, w, g, i);
      of->residual[g * w->n + i] = (q - w->X[g * w->n + i]) + DRIFT[g] * along.high +
          (unit_of(w, i) * sum + low_words(w, g, along, i));
    }
  }
}

/* Squared scaled size of the coordinates in the step. */
static double size_of_state(const linear_system *of)
{
  const step_points *w = of->points;
  sums all;
  begin_sums(&all, w->run, w->n);
  while (next_block(&all)) {
    double size = 0.0;
    for (long long i = all.here.first; i < all.here.end; i++) {
      const double q = w->step->q0[i], part = fabs(q) + fabs(find_drift(w, i).high);
      const double of_one = of->by_size.scale * (part + fabs(at_point(&w->X[i], w->n, KEPT - 1) - q));
      size += of_one * of_one;
    }
    add_block(&all, size, 0.0);
  }
  wait_at_barrier(w->run);
  return sum_of(&all, 0);
}

/* Starts from the extrapolated points or from points at rest, whichever has the smaller residual: the forces of a stiff
 * system have no curve that could be extrapolated. */
static void start_nearer(linear_system *of)
{
  const step_points *w = of->points;
  step_points rest = *w;
  double continued, at_rest;
  rest.X = of->correction, rest.F = of->forces;
  find_residual(of, w);
  continued = inner_product(of, of->residual, of->residual);
  for (int g = 0; g < GROUPS; g++)
    for (long long i = of->own.first; i < of->own.end; i++)
      rest.X[g * of->n + i] = lanes_of(w->step->q0[i]);
  forces_at_points(&rest);
  find_residual(of, &rest);
  at_rest = inner_product(of, of->residual, of->residual);
  if (continued <= at_rest)
    return;
  scale(of, w->X, 1.0, rest.X);
  scale(of, w->F, 1.0, rest.F);
}

/* Iterates until the points converge. The tables extrapolate from *guess steps. On success *guess is the number of
 * steps for the next predictor, and *error the error estimate. */
static int solve(run_memory *run, const problem *given, long long n, const struct predictor_tables_of *tables,
    long long *guess, double decay, double *error, const solver_options *options, solver_report *report)
{
  iteration now = new_iteration();
  array_step step;
  const step_points *w = &step.points;
  linear_system of;
  double largest;
  begin_step(run, given, n, &step);
  of = linear_of(w);
  largest = first_points(w, tables, *guess);
  forces_at_points(w);
  largest = largest_moved(w, largest);
  of.by_size = measures_of(largest);
  start_nearer(&of);
  of.state = sqrt(size_of_state(&of));
  while (now.status == 0) {
    double total[3] = {0.0}, left;
    find_residual(&of, w);
    if (now.last.of_all > REFRESHED) /* also before the first iteration */
      find_inverses(&of);
    left = find_correction(&of, report);
    add_multiple(&of, w->X, 1.0, of.correction);
    forces_at_points(w);
    total[0] = inner_product(&of, of.correction, of.correction);
    total[2] = size_of_state(&of);
    of.state = sqrt(total[2]);
    record_change(&now, relative_changes(total, &of.by_size, n, options), options, report);
    if (now.status > 0 && !(left <= UNSOLVED * of.state)) /* an unsolved linear system does not count as a small
                                                           * correction */
      now.status = -1, now.last.of_all = left;
  }
  if (now.status < 0)
    return failure_of(&now);
  *guess = steps_to_continue(*guess, now.first);
  return examine(w, largest, decay, error) ? OK : NOT_FINITE;
}
