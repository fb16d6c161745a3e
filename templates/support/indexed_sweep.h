/* A step of any number of coordinates, for constant diagonal masses and forces of position, time and perhaps velocity:
 * that of separable_sweep.h, a coordinate at a time, with norms over all of them. Before it: points.h, contraction.h,
 * the tables, forces. After it: solve, by sweeps or by Newton's iteration. */

/* The parts of work, group after group of points: positions of all coordinates (velocities behind them), and forces
 * there in this step, the last and the one before. */
typedef struct {
  lanes *X, *F, *last, *before;
} parts_of_work;

enum { OF_EACH = 1 + VELOCITIES }; /* numbers of a coordinate in X */

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

static lengths lengths_of(double h)
{
  const lengths of = {h, h * h, fma(h, h, -(h * h))};
  return of;
}

/* h v of a coordinate in two parts. */
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

/* Where the points of a block stand by the forces of former steps, or without any; returned is the largest coordinate,
 * and its drift. */
static double first_of_block(const run_memory *run, const parts_of_work *parts, const lengths *by, long long n,
    const struct guess_tables *tables, long long guess, section here)
{
  double largest = DBL_MIN;
  for (long long i = here.first; i < here.end; i++) {
    double low;
    const double drift = drift_of(run, i, &low), unit = by->square * run->inverse_mass[i];
    for (int g = 0; g < GROUPS; g++) {
      lanes bend = lanes_of(0.0);
      if (guess == 1)
        bend = given_by_all(tables->alone, g, &parts->last[i], n);
      else if (guess > 1)
        bend = given_by_all(tables->last, g, &parts->last[i], n) +
            given_by_all(tables->before, g, &parts->before[i], n);
      if (VELOCITIES) /* forces were continued, of which velocities are made, too */
        parts->F[g * n + i] = bend;
      parts->X[g * OF_EACH * n + i] = run->q[i] + DRIFT[g] * drift;
      if (!VELOCITIES && guess > 0)
        parts->X[g * OF_EACH * n + i] += unit * bend;
    }
    for (int g = 0; VELOCITIES && g < GROUPS; g++)
      parts->X[g * OF_EACH * n + i] += unit * given_by_all(PRODUCT, g, &parts->F[i], n);
    largest = larger(largest, fabs(run->q[i]) + fabs(drift));
  }
  return largest;
}

/* The same of all; the largest. */
static double first_positions(const run_memory *run, const parts_of_work *parts, const lengths *by, long long n,
    const struct guess_tables *tables, long long guess)
{
  sums all;
  begin_sums(&all, run, n);
  while (next_block(&all))
    add_block(&all, first_of_block(run, parts, by, n, tables, guess, all.here), 0.0);
  wait_for_others(run);
  return largest_of(&all, 0);
}

/* The largest coordinate at the last point: of a step from rest at 0 the only size there is. */
static double largest_at_end(const run_memory *run, const lanes *X, long long n)
{
  sums all;
  begin_sums(&all, run, n);
  while (next_block(&all)) {
    double largest = DBL_MIN;
    for (long long i = all.here.first; i < all.here.end; i++)
      largest = larger(largest, fabs(at_point(&X[i], OF_EACH * n, KEPT - 1)));
    add_block(&all, largest, 0.0);
  }
  wait_for_others(run);
  return largest_of(&all, 0);
}

/* What the highest coefficient of the forces at the points moves a coordinate of a block by, squared, over what they
 * bend it by: the largest of these, everything as a part of the largest coordinate. That coefficient is taken for at
 * least `decay` times the one below (coefficients.h). No number where a force is none. */
static double unresolved(const run_memory *run, const lanes *F, const lengths *by, long long n, double largest,
    double decay, section here)
{
  lanes faults = lanes_of(0.0);
  double least = 0.0;
  for (long long i = here.first; i < here.end; i++) {
    const double unit = by->square * run->inverse_mass[i];
    const double size = fabs(run->q[i]) + fabs(by->h * run->inverse_mass[i] * run->p[i]) + largest;
    const double ends = fabs(at_point(&F[i], n, 0)) + fabs(at_point(&F[i], n, KEPT - 1));
    const double bend = fabs(unit) * ends + NEGLIGIBLE * size;
    const double top = unit * top_coefficient(&F[i], n, decay);
    for (int g = 0; g < GROUPS; g++)
      faults += 0.0 * F[g * n + i];
    least = larger(least, top * top / (bend * size));
  }
  return least + lanes_total(faults);
}

/* Whether all forces are finite; and the largest of these of all. */
static int examine(const run_memory *run, const lanes *F, const lengths *by, long long n, double largest, double decay,
    double *error)
{
  sums all;
  begin_sums(&all, run, n);
  while (next_block(&all)) {
    const double found = unresolved(run, F, by, n, largest, decay, all.here);
    add_block(&all, found, found == found ? 0.0 : 1.0);
  }
  wait_for_others(run);
  *error = largest_of(&all, 0);
  return sum_of(&all, 1) == 0.0;
}

/* The state at the end of the step. */
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
    const double bent = inverse * (by->square * sum), increment = drift + bent, part = increment - drift;
    const double low = (drift - (increment - part)) + (bent - part) + (drift_low + inverse * (by->square_low * sum));
    add_compensated(&run->q[i], &run->carry_q[i], increment, low);
    add_compensated(&run->p[i], &run->carry_p[i], weigh_apart_twice(kick, kick_low, &F[i], n), 0.0);
  }
}

/* On to the end of the step that was solved. */
static void go_on(run_memory *run, long long n)
{
  const lengths by = lengths_of(run->h);
  move(run, divide(run, n).F, &by, n);
}
