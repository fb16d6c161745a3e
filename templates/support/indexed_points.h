/* Step of an indexed system with constant diagonal masses and forces that depend on position, time and perhaps
 * velocity: the scheme of separable_iteration.h, coordinate by coordinate, with norms over all of them. Requires:
 * points.h, convergence.h, the tables, forces. Include before solve, by fixed-point iteration or Newton's method. */

/* Parts of work, by groups of points: positions of all coordinates (then velocities), and forces there in this step,
 * the last one and the one before. */
typedef struct {
  lanes *X, *F, *last, *before;
} parts_of_work;

enum { OF_EACH = 1 + VELOCITIES }; /* values per coordinate in X */

static parts_of_work divide(const run_memory *run, long long n)
{
  lanes *work = (lanes *)run->work, *forces_of[3];
  parts_of_work parts;
  for (int k = 0; k < 3; k++)
    forces_of[(k + run->turn) % 3] = work + (k + OF_EACH) * GROUPS * n;
  parts.X = work;
  parts.F = forces_of[0], parts.last = forces_of[1], parts.before = forces_of[2];
  return parts;
}

/* h^2 = square + square_low. */
typedef struct {
  double h, square, square_low;
} lengths;

static lengths sizes_of_steps(double h)
{
  const lengths of = {h, h * h, fma(h, h, -(h * h))};
  return of;
}

/* h v of a coordinate as a double-double number. */
static inline double drift_of(const run_memory *run, long long i, double *low)
{
  const double v = run->inverse_mass[i] * run->p[i], v_low = fma(run->inverse_mass[i], run->p[i], -v);
  const double drift = run->h * v;
  *low = fma(run->h, v, -drift) + run->h * (v_low + run->inverse_mass[i] * run->carry_p[i]);
  return drift;
}

static void forces_at_points(const run_memory *run, const problem *given, const lanes *X, lanes *F, long long n)
{
  forces(run, given, X, OF_EACH * n, F, n);
}

/* Initial points of a block, with forces extrapolated from former steps or without any; returns the largest sum of a
 * coordinate and its drift. */
static double first_of_block(const run_memory *run, const parts_of_work *parts, const lengths *by, long long n,
    const struct predictor_tables_of *tables, long long guess, section here)
{
  double largest = DBL_MIN;
  for (long long i = here.first; i < here.end; i++) {
    double low;
    const double drift = drift_of(run, i, &low), unit = by->square * run->inverse_mass[i];
    for (int g = 0; g < GROUPS; g++) {
      lanes curvature = lanes_of(0.0);
      if (guess == 1)
        curvature = contribution_of_points(tables->alone, g, &parts->last[i], n);
      else if (guess > 1)
        curvature = contribution_of_points(tables->last, g, &parts->last[i], n) +
            contribution_of_points(tables->before, g, &parts->before[i], n);
      if (VELOCITIES) /* the extrapolation is of forces, from which velocities follow, too */
        parts->F[g * n + i] = curvature;
      parts->X[g * OF_EACH * n + i] = run->q[i] + DRIFT[g] * drift;
      if (!VELOCITIES && guess > 0)
        parts->X[g * OF_EACH * n + i] += unit * curvature;
    }
    for (int g = 0; VELOCITIES && g < GROUPS; g++)
      parts->X[g * OF_EACH * n + i] += unit * contribution_of_points(PRODUCT, g, &parts->F[i], n);
    largest = larger(largest, fabs(run->q[i]) + fabs(drift));
  }
  return largest;
}

/* Computes the initial points (first_of_block); returns the largest value. */
static double first_positions(const run_memory *run, const parts_of_work *parts, const lengths *by, long long n,
    const struct predictor_tables_of *tables, long long guess)
{
  sums all;
  begin_sums(&all, run, n);
  while (next_block(&all))
    add_block(&all, first_of_block(run, parts, by, n, tables, guess, all.here), 0.0);
  wait_at_barrier(run);
  return largest_of(&all, 0);
}

/* Returns the largest coordinate. If squares of it would overflow or underflow, it includes the displacements by the
 * forces at the first and the last point: the only size available in a step from rest at 0. */
static double largest_moved(const run_memory *run, const lanes *F, const lengths *by, long long n, double largest)
{
  sums all;
  if (scale_of(largest) == 1.0)
    return largest;
  begin_sums(&all, run, n);
  while (next_block(&all)) {
    double of_block = largest;
    for (long long i = all.here.first; i < all.here.end; i++) {
      const double ends = fabs(at_point(&F[i], n, 0)) + fabs(at_point(&F[i], n, KEPT - 1));
      of_block = larger(of_block, by->square * run->inverse_mass[i] * ends);
    }
    add_block(&all, of_block, 0.0);
  }
  wait_at_barrier(run);
  return largest_of(&all, 0);
}

/* Error estimate of a block: the largest value of (displacement due to the leading coefficient of the forces)^2 /
 * (displacement due to the curvature), all relative to the largest coordinate. The coefficient is at least `decay`
 * times the next lower one (coefficients.h). NaN if a force is not finite. */
static double unresolved(const run_memory *run, const lanes *F, const lengths *by, long long n, double largest,
    double decay, section here)
{
  const double scale = scale_of(largest);
  lanes faults = lanes_of(0.0);
  double least = 0.0;
  for (long long i = here.first; i < here.end; i++) {
    const double unit = scale * (by->square * run->inverse_mass[i]);
    const double size = scale * (fabs(run->q[i]) + fabs(by->h * run->inverse_mass[i] * run->p[i]) + largest);
    const double ends = fabs(at_point(&F[i], n, 0)) + fabs(at_point(&F[i], n, KEPT - 1));
    const double curvature = fabs(unit) * ends + NEGLIGIBLE * size;
    const double top = unit * top_coefficient(&F[i], n, decay);
    for (int g = 0; g < GROUPS; g++)
      faults += 0.0 * F[g * n + i];
    least = larger(least, top * top / larger(curvature * size, DBL_MIN)); /* all may be 0 */
  }
  return least + lanes_total(faults);
}

/* Returns 1 if all forces are finite; *error is the error estimate over all blocks. */
static int examine(const run_memory *run, const lanes *F, const lengths *by, long long n, double largest, double decay,
    double *error)
{
  sums all;
  begin_sums(&all, run, n);
  while (next_block(&all)) {
    const double found = unresolved(run, F, by, n, largest, decay, all.here);
    add_block(&all, found, found == found ? 0.0 : 1.0);
  }
  wait_at_barrier(run);
  *error = largest_of(&all, 0);
  return sum_of(&all, 1) == 0.0;
}

/* Advances the state to the end of the step. */
static void move(run_memory *run, const lanes *F, const lengths *by, long long n)
{
  const section own = mine(run, n);
  lanes kick[GROUPS], kick_low[GROUPS];
  for (int g = 0; g < GROUPS; g++) {
    kick[g] = by->h * POINT_END_MOMENTUM[g];
    kick_low[g] = fused_weights(by->h, POINT_END_MOMENTUM[g], -kick[g]) + by->h * POINT_END_MOMENTUM_LOW[g];
  }
  for (long long i = own.first; i < own.end; i++) {
    double drift_low;
    const double drift = drift_of(run, i, &drift_low), inverse = run->inverse_mass[i];
    const double sum = weigh_apart_twice(POINT_END_POSITION, POINT_END_POSITION_LOW, &F[i], n);
    const double displacement = inverse * (by->square * sum), increment = drift + displacement,
                 part = increment - drift;
    const double low_displacement = drift_low + inverse * (by->square_low * sum);
    const double low = (drift - (increment - part)) + (displacement - part) + low_displacement;
    add_compensated(&run->q[i], &run->carry_q[i], increment, low);
    add_compensated(&run->p[i], &run->carry_p[i], weigh_apart_twice(kick, kick_low, &F[i], n), 0.0);
  }
}

/* Advances the state to the end of the solved step. */
static void continue_steps(run_memory *run, long long n)
{
  const lengths by = sizes_of_steps(run->h);
  move(run, divide(run, n).F, &by, n);
}
