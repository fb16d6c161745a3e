/* A step of any number of coordinates by sweeps, for any Hamiltonian: positions and momenta y at the points follow
 * their rates there until they rest. Before it: points.h, contraction.h, the tables, coefficients.h, forces, which
 * gives the slopes G at X: -H_q, by which momenta change, and behind it H_p, by which positions do. Momenta stand
 * behind positions. */

/* The parts of work, group after group of points: y there, and slopes in this step, the last and the one before. */
typedef struct {
  lanes *X, *G, *last, *before;
} parts_of_work;

static parts_of_work divide(const run_memory *run, long long n)
{
  lanes *work = (lanes *)run->work, *slopes_of[3];
  parts_of_work parts;
  for (int k = 0; k < 3; k++)
    slopes_of[(k + run->turn) % 3] = work + (k + 1) * GROUPS * 2 * n;
  parts.X = work;
  parts.G = slopes_of[0], parts.last = slopes_of[1], parts.before = slopes_of[2];
  return parts;
}

/* Slopes continued from former steps. */
static void continue_slopes(const parts_of_work *parts, long long n, const struct guess_tables *tables, long long guess)
{
  const long long apart = 2 * n;
  for (int g = 0; g < GROUPS; g++)
    for (long long i = 0; i < apart; i++)
      parts->G[g * apart + i] = guess == 1 ? given_by_all(tables->alone, g, &parts->last[i], apart)
                                           : given_by_all(tables->last, g, &parts->last[i], apart) +
              given_by_all(tables->before, g, &parts->before[i], apart);
}

/* n places of y from `first` on by their rates, of which a table and weights make increments; returned is the sum of
 * the squares of what that changes, over that of their sizes if these are not absolute. */
static double improve(const run_memory *run, lanes *X, const lanes *rates, const lanes *table, const lanes *weights,
    long long first, long long n, int absolute)
{
  const long long apart = 2 * n;
  lanes total = lanes_of(0.0);
  double size = 0.0;
  for (long long i = first; i < first + n; i++) {
    lanes scaled[GROUPS], increment[GROUPS];
    double of_one;
    for (int g = 0; g < GROUPS; g++)
      scaled[g] = run->h * weights[g] * rates[g * apart + i - first];
    for (int g = 0; g < GROUPS; g++) {
      lanes y, moved;
      increment[g] = given_by_all(table, g, scaled, 1);
      y = run->q[i] + (run->carry_q[i] + increment[g]), moved = y - X[g * apart + i];
      total += moved * moved;
      X[g * apart + i] = y;
    }
    of_one = fabs(run->q[i]) + fabs(at_point(increment, 1, POINTS - 1));
    size += of_one * of_one;
  }
  return absolute || size == 0.0 ? lanes_total(total) + 0.0 * size : lanes_total(total) / size;
}

/* Whether all slopes are finite. */
static int finite_slopes(const lanes *G, long long n)
{
  lanes faults = lanes_of(0.0);
  for (long long i = 0; i < GROUPS * 2 * n; i++)
    faults += 0.0 * G[i];
  return lanes_total(faults) == 0.0;
}

/* About how far a coordinate moves in a step. */
static inline double moved_by(const run_memory *run, const lanes *velocity, long long n, long long i)
{
  return fabs(run->h * at_point(&velocity[i], 2 * n, KEPT / 2));
}

/* What the highest coefficient of the velocities at the points moves a coordinate by, squared, over what they bend it
 * by: the largest of these, everything as a part of the largest coordinate. That coefficient is taken for at least
 * `decay` times the one below (coefficients.h). */
static double unresolved(const run_memory *run, const lanes *velocity, long long n, double decay)
{
  double largest = DBL_MIN, least = 0.0;
  for (long long i = 0; i < n; i++)
    largest = larger(largest, fabs(run->q[i]) + moved_by(run, velocity, n, i));
  for (long long i = 0; i < n; i++) {
    const lanes *rate = &velocity[i];
    const double size = fabs(run->q[i]) + moved_by(run, velocity, n, i) + largest;
    const double start = at_point(rate, 2 * n, 0), middle = at_point(rate, 2 * n, KEPT / 2);
    const double ends = fabs(at_point(rate, 2 * n, KEPT - 1) - start) + fabs(middle - start);
    const double bend = fabs(run->h) * ends + NEGLIGIBLE * size;
    const double top = run->h * top_coefficient(rate, 2 * n, decay);
    least = larger(least, top * top / (bend * size));
  }
  return least;
}

/* The end of the step, of n places from `first` on. */
static void move(run_memory *run, const lanes *rates, const lanes *end, const lanes *weights, long long first,
    long long n)
{
  for (long long i = first; i < first + n; i++) {
    lanes scaled[GROUPS];
    for (int g = 0; g < GROUPS; g++)
      scaled[g] = run->h * weights[g] * rates[g * 2 * n + i - first];
    add_compensated(&run->q[i], &run->carry_q[i], weigh_apart(end, scaled, 1), 0.0);
  }
}

/* Sweeps until the points rest. Errors of positions become errors of momenta in a sweep, and back in the next: changes
 * are judged in pairs. The tables continue so many steps; then `guess` is how many are best continued into the next,
 * and `error` what the curve leaves unresolved. */
static int solve(run_memory *run, const problem *given, long long n, const struct guess_tables *tables,
    long long *guess, double decay, double *error, const solver_options *options, solver_report *report)
{
  const parts_of_work parts = divide(run, n);
  iteration now = at_its_start();
  double change = 0.0;
  if (*guess > 0)
    continue_slopes(&parts, n, tables, *guess);
  else
    memset(parts.G, 0, sizeof(lanes) * GROUPS * 2 * (size_t)n);
  for (int k = 0; now.status == 0; k++) {
    const double of_q = improve(run, parts.X, parts.G + n, POSITION, POSITION_WEIGHT, 0, n, options->absolute);
    const double of_p = improve(run, parts.X, parts.G, MOMENTUM, MOMENTUM_WEIGHT, n, n, options->absolute);
    for (int g = 0; g < GROUPS; g++)
      forces(given, parts.X + g * 2 * n, run->t + run->h * ABSCISSA[g], parts.G + g * 2 * n, 2 * n);
    change = k % 2 ? of_q + of_p : change + of_q + of_p;
    if (k > 0 && k % 2 == 0)
      judge(&now, change, options, report);
  }
  if (now.status < 0)
    return failure_of(&now);
  if (!finite_slopes(parts.G, n))
    return NOT_FINITE;
  *error = unresolved(run, parts.G + n, n, decay);
  *guess = steps_to_continue(*guess, now.first);
  return OK;
}

/* On to the end of the step that was solved. */
static void go_on(run_memory *run, long long n)
{
  const lanes *G = divide(run, n).G;
  move(run, G + n, POINT_END_POSITION, POSITION_WEIGHT, 0, n);
  move(run, G, POINT_END_MOMENTUM, MOMENTUM_WEIGHT, n, n);
}
