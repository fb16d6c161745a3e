/* The points of a step of any number of coordinates, by sweeps. Before it: indexed_sweep.h. */

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

/* Sweeps until the points rest; then once more with all digits of the coefficients. The tables continue so many steps;
 * then `guess` is how many are best continued into the next, and `error` what the curve leaves unresolved. */
static int solve(run_memory *run, const problem *given, long long n, const struct guess_tables *tables,
    long long *guess, double decay, double *error, const solver_options *options, solver_report *report)
{
  const parts_of_work parts = divide(run, n);
  const lengths by = lengths_of(run->h);
  iteration now = at_its_start();
  double largest = first_positions(run, &parts, &by, n, tables, *guess), size = 0.0;
  improve_velocities(run, &parts, &by, n);
  forces_at_points(run, given, parts.X, parts.F, n);
  while (now.status == 0) {
    double change = improve(run, &parts, &by, n, now.count == 0 ? &size : NULL);
    change += improve_velocities(run, &parts, &by, n);
    forces_at_points(run, given, parts.X, parts.F, n);
    judge(&now, beside_state(change, size, options), options, report);
  }
  if (now.status < 0)
    return failure_of(&now);
  last_positions(run, &parts, &by, n);
  if (largest <= DBL_MIN)
    largest = largest_at_end(parts.X, n);
  improve_velocities(run, &parts, &by, n);
  forces_at_points(run, given, parts.X, parts.F, n);
  *guess = steps_to_continue(*guess, now.first);
  return examine(run, parts.F, &by, n, largest, decay, error) ? OK : NOT_FINITE;
}
