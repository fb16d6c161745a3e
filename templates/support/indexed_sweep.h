/* A step of any number of coordinates by sweeps, for constant diagonal masses and forces of position, time and perhaps
 * velocity: that of separable_sweep.h, a coordinate at a time, with norms over all of them. Before it: points.h,
 * contraction.h, the tables, forces. */

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
  for (int g = 0; g < GROUPS; g++)
    forces(given, X + g * OF_EACH * n, run->t + run->h * ABSCISSA[g], F + g * n, n);
}

/* Where the points stand by the forces of former steps, or without any; returned is the largest coordinate, and its
 * drift. */
static double first_positions(const run_memory *run, const parts_of_work *parts, const lengths *by, long long n,
    const struct guess_tables *tables, long long guess)
{
  double largest = DBL_MIN;
  for (long long i = 0; i < n; i++) {
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

/* The points by the forces; returned is the sum of the squares of what that changes, and added to `size`, if it is not
 * NULL, that of the sizes of the coordinates. */
static double improve(const run_memory *run, const parts_of_work *parts, const lengths *by, long long n, double *size)
{
  lanes total = lanes_of(0.0);
  for (long long i = 0; i < n; i++) {
    double low;
    const double drift = drift_of(run, i, &low), unit = by->square * run->inverse_mass[i];
    for (int g = 0; g < GROUPS; g++) {
      const lanes x = (run->q[i] + DRIFT[g] * drift) + unit * given_by_all(PRODUCT, g, &parts->F[i], n);
      const lanes moved = x - parts->X[g * OF_EACH * n + i];
      total += moved * moved;
      parts->X[g * OF_EACH * n + i] = x;
    }
    if (size) {
      const double of_one = fabs(run->q[i]) + fabs(drift) + fabs(unit * at_point(&parts->F[i], n, 0));
      *size += of_one * of_one;
    }
  }
  return lanes_total(total);
}

#if VELOCITIES
/* Velocities at the points by the forces; returned is the sum of the squares of what that changes, times h. */
static double improve_velocities(const run_memory *run, const parts_of_work *parts, const lengths *by, long long n)
{
  lanes total = lanes_of(0.0);
  for (int g = 0; g < GROUPS; g++) {
    lanes *V = parts->X + (g * OF_EACH + 1) * n;
    for (long long i = 0; i < n; i++) {
      const lanes kick = run->carry_p[i] + by->h * given_by_all(VELOCITY, g, &parts->F[i], n);
      const lanes v = run->inverse_mass[i] * (run->p[i] + kick), moved = by->h * (v - V[i]);
      total += moved * moved;
      V[i] = v;
    }
  }
  return lanes_total(total);
}
#else
static double improve_velocities(const run_memory *run, const parts_of_work *parts, const lengths *by, long long n)
{
  (void)run, (void)parts, (void)by, (void)n;
  return 0.0;
}
#endif

/* x + (y + rest) for a rest that is less than the rounding of x + y, which would round it away. */
static inline lanes sum_of_three(lanes x, lanes y, lanes rest)
{
  const lanes sum = x + y, part = sum - x;
  return sum + (((x - (sum - part)) + (y - part)) + rest);
}

/* The points with all digits of the coefficients. */
static void last_positions(const run_memory *run, const parts_of_work *parts, const lengths *by, long long n)
{
  for (long long i = 0; i < n; i++) {
    double drift_low;
    const double drift = drift_of(run, i, &drift_low), inverse = run->inverse_mass[i];
    for (int g = 0; g < GROUPS; g++) {
      const lanes sum = given_by_all(PRODUCT, g, &parts->F[i], n), low = given_by_all(PRODUCT_LOW, g, &parts->F[i], n);
      const lanes rest = run->carry_q[i] + DRIFT[g] * drift_low + DRIFT_LOW[g] * drift;
      parts->X[g * OF_EACH * n + i] = sum_of_three(lanes_of(run->q[i]), DRIFT[g] * drift + inverse * (by->square * sum),
          rest + inverse * (by->square * low + by->square_low * sum));
    }
  }
}

/* The largest coordinate at the last point: of a step from rest at 0 the only size there is. */
static double largest_at_end(const lanes *X, long long n)
{
  double largest = DBL_MIN;
  for (long long i = 0; i < n; i++)
    largest = larger(largest, fabs(at_point(&X[i], OF_EACH * n, KEPT - 1)));
  return largest;
}

/* Whether all forces are finite. And what the highest coefficient of the forces at the points moves a coordinate by,
 * squared, over what they bend it by: the largest of these, everything as a part of the largest coordinate. */
static int examine(const run_memory *run, const lanes *F, const lengths *by, long long n, double largest, double *error)
{
  lanes faults = lanes_of(0.0);
  double least = 0.0;
  for (long long i = 0; i < n; i++) {
    const double unit = by->square * run->inverse_mass[i];
    const double size = fabs(run->q[i]) + fabs(by->h * run->inverse_mass[i] * run->p[i]) + largest;
    const double ends = fabs(at_point(&F[i], n, 0)) + fabs(at_point(&F[i], n, KEPT - 1));
    const double bend = fabs(unit) * ends + NEGLIGIBLE * size;
    const double top = RESOLVED * unit * weigh_apart(HIGHEST, &F[i], n);
    for (int g = 0; g < GROUPS; g++)
      faults += 0.0 * F[g * n + i];
    least = larger(least, top * top / (bend * size));
  }
  *error = least;
  return lanes_total(faults) == 0.0;
}

/* The state at the end of the step. */
static void move(run_memory *run, const lanes *F, const lengths *by, long long n)
{
  lanes kick[GROUPS], kick_low[GROUPS];
  for (int g = 0; g < GROUPS; g++) {
    kick[g] = by->h * POINT_END_MOMENTUM[g];
    kick_low[g] = fused_weights(by->h, POINT_END_MOMENTUM[g], -kick[g]) + by->h * POINT_END_MOMENTUM_LOW[g];
  }
  for (long long i = 0; i < n; i++) {
    double drift_low;
    const double drift = drift_of(run, i, &drift_low), inverse = run->inverse_mass[i];
    const double sum = weigh_apart_twice(POINT_END_POSITION, POINT_END_POSITION_LOW, &F[i], n);
    const double bent = inverse * (by->square * sum), increment = drift + bent, part = increment - drift;
    const double low = (drift - (increment - part)) + (bent - part) + (drift_low + inverse * (by->square_low * sum));
    add_compensated(&run->q[i], &run->carry_q[i], increment, low);
    add_compensated(&run->p[i], &run->carry_p[i], weigh_apart_twice(kick, kick_low, &F[i], n), 0.0);
  }
}

/* Sweeps until the points rest; then once more with all digits of the coefficients. The tables continue so many steps;
 * then `guess` is how many are best continued into the next, and `error` what the curve leaves unresolved. */
static int solve(run_memory *run, const problem *given, long long n, const struct guess_tables *tables,
    long long *guess, double *error, const solver_options *options, solver_report *report)
{
  const parts_of_work parts = divide(run, n);
  const lengths by = lengths_of(run->h);
  double largest = first_positions(run, &parts, &by, n, tables, *guess), size = 0.0, first = 0.0, last = INFINITY;
  int status = 0;
  improve_velocities(run, &parts, &by, n);
  forces_at_points(run, given, parts.X, parts.F, n);
  for (int k = 0; status == 0; k++) {
    double change = improve(run, &parts, &by, n, k == 0 ? &size : NULL);
    change += improve_velocities(run, &parts, &by, n);
    change = options->absolute || size == 0.0 ? change + 0.0 * size : change / size;
    forces_at_points(run, given, parts.X, parts.F, n);
    status = sweep_status(change, last, options, k);
    first = k == 0 ? change : first;
    last = change;
    report->iterations++;
  }
  report->change = sqrt(last);
  if (status < 0)
    return last < INFINITY ? NOT_CONVERGED : NOT_FINITE;
  last_positions(run, &parts, &by, n);
  if (largest <= DBL_MIN)
    largest = largest_at_end(parts.X, n);
  improve_velocities(run, &parts, &by, n);
  forces_at_points(run, given, parts.X, parts.F, n);
  *guess = steps_to_continue(*guess, first);
  return examine(run, parts.F, &by, n, largest, error) ? OK : NOT_FINITE;
}

/* On to the end of the step that was solved. */
static void go_on(run_memory *run, long long n)
{
  const lengths by = lengths_of(run->h);
  move(run, divide(run, n).F, &by, n);
}
