/* Newton's method for the points of a step of an indexed system. Requires: indexed_newton.h, gmres.h. */

#define REFRESHED 1e-6 /* squared: the preconditioner is recomputed while points change by more than 1e-3 of the
                        * state */
#define UNSOLVED 1e-10 /* relative to the state: a larger residual is not due to rounding */

/* Parts of work behind those of the fixed-point iteration. */
static linear_system linear_of(const run_memory *run, const problem *given, const parts_of_work *parts, long long n)
{
  const long long count = GROUPS * n;
  lanes *work = (lanes *)run->work + ITERATION_VECTORS * count;
  const linear_system of = {.run = run,
      .given = given,
      .by = sizes_of_steps(run->h),
      .n = n,
      .count = count,
      .own = mine(run, n),
      .X = parts->X,
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

/* Residual: the change by one fixed-point iteration at points X with forces F, for the coordinates of this thread. */
static void find_residual(linear_system *of, const lanes *X, const lanes *F)
{
  const run_memory *run = of->run;
  const long long n = of->n;
  for (long long i = of->own.first; i < of->own.end; i++) {
    double low;
    const double drift = drift_of(run, i, &low), unit = of->by.square * run->inverse_mass[i];
    for (int g = 0; g < GROUPS; g++) {
      const lanes sum = contribution_of_points(PRODUCT, g, &F[i], n) + contribution_of_points(PRODUCT_LOW, g, &F[i], n);
      const lanes rest = run->carry_q[i] + DRIFT[g] * low + DRIFT_LOW[g] * drift;
      of->residual[g * n + i] = (run->q[i] - X[g * n + i]) + DRIFT[g] * drift + (unit * sum + rest);
    }
  }
}

/* Squared scaled size of the coordinates in the step. */
static double size_of_state(const linear_system *of, const lanes *X)
{
  const run_memory *run = of->run;
  sums all;
  begin_sums(&all, run, of->n);
  while (next_block(&all)) {
    double size = 0.0;
    for (long long i = all.here.first; i < all.here.end; i++) {
      double low;
      const double part = fabs(run->q[i]) + fabs(drift_of(run, i, &low));
      const double of_one = of->by_size.scale * (part + fabs(at_point(&X[i], of->n, KEPT - 1) - run->q[i]));
      size += of_one * of_one;
    }
    add_block(&all, size, 0.0);
  }
  wait_at_barrier(run);
  return sum_of(&all, 0);
}

/* Starts from the extrapolated points or from points at rest, whichever has the smaller residual: the forces of a stiff
 * system have no curve that could be extrapolated. */
static void start_nearer(linear_system *of, const parts_of_work *parts)
{
  const run_memory *run = of->run;
  double continued, at_rest;
  find_residual(of, parts->X, parts->F);
  continued = inner_product(of, of->residual, of->residual);
  for (int g = 0; g < GROUPS; g++)
    for (long long i = of->own.first; i < of->own.end; i++)
      of->correction[g * of->n + i] = lanes_of(run->q[i]);
  forces_at_points(run, of->given, of->correction, of->forces, of->n);
  find_residual(of, of->correction, of->forces);
  at_rest = inner_product(of, of->residual, of->residual);
  if (continued <= at_rest)
    return;
  scale(of, parts->X, 1.0, of->correction);
  scale(of, parts->F, 1.0, of->forces);
}

/* Iterates until the points converge. The tables extrapolate from *guess steps. On success *guess is the number of
 * steps for the next predictor, and *error the error estimate. */
static int solve(run_memory *run, const problem *given, long long n, const struct predictor_tables_of *tables,
    long long *guess, double decay, double *error, const solver_options *options, solver_report *report)
{
  const parts_of_work parts = divide(run, n);
  linear_system of = linear_of(run, given, &parts, n);
  double largest = first_positions(run, &parts, &of.by, n, tables, *guess);
  iteration now = new_iteration();
  forces_at_points(run, given, parts.X, parts.F, n);
  largest = largest_moved(run, parts.F, &of.by, n, largest);
  of.by_size = measures_of(largest);
  start_nearer(&of, &parts);
  of.state = sqrt(size_of_state(&of, parts.X));
  while (now.status == 0) {
    double total[3] = {0.0}, left;
    find_residual(&of, parts.X, parts.F);
    if (now.last.of_all > REFRESHED) /* also before the first iteration */
      find_inverses(&of);
    left = find_correction(&of, report);
    add_multiple(&of, parts.X, 1.0, of.correction);
    forces_at_points(run, given, parts.X, parts.F, n);
    total[0] = inner_product(&of, of.correction, of.correction);
    total[2] = size_of_state(&of, parts.X);
    of.state = sqrt(total[2]);
    record_change(&now, relative_changes(total, &of.by_size, n, options), options, report);
    if (now.status > 0 && !(left <= UNSOLVED * of.state)) /* an unsolved linear system does not count as a small
                                                           * correction */
      now.status = -1, now.last.of_all = left;
  }
  if (now.status < 0)
    return failure_of(&now);
  *guess = steps_to_continue(*guess, now.first);
  return examine(run, parts.F, &of.by, n, largest, decay, error) ? OK : NOT_FINITE;
}
