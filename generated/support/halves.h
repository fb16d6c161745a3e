/* Comparison of a step with two steps of half its size. It detects errors that the curve of the step does not show: too
 * few points, forces that vanish at them, or a spurious solution of the stage equations. Requires: comparison.h,
 * prepare and solve of a solver, duration. */

static real duration(const step_data *step, const solver_data *data, const real *memory, long long guess,
    real *workspace);

/* Solves a step without a predictor and adds its increments, without their low words, to dq and dp. */
static SELDOM int add_part(step_data *part, const solver_options *options, real *dq, real *dp)
{
  real memory[MEMORY], own_q[2 * M] = {0}, own_p[2 * M] = {0};
  solver_report report = {0};
  solver_data data;
  long long guess = 0;
  int status;
  prepare(part, &data);
  status = solve(part, &data, memory, &guess, own_q, own_p, options, &report, part->scratch + SCRATCH);
  if (status != OK)
    return status;
  part->t += duration(part, &data, memory, guess, part->scratch + SCRATCH);
  for (int i = 0; i < M; i++) {
    dq[i] += own_q[i];
    dp[i] += own_p[i];
  }
  return 0 * part->t == 0 ? OK : NOT_FINITE;
}

/* Solves two steps of h/2: the increments of both, and those of q by the first. */
static SELDOM int solve_halves(const step_data *step, real h, const solver_options *options, real *dq, real *dp,
    real *first)
{
  const real nothing[M] = {0};
  real q[M], p[M];
  step_data part = *step;
  int status;
  part.h = h / 2;
  part.first = 1;
  part.tables = NULL;
  memset(dq, 0, sizeof(real) * M);
  memset(dp, 0, sizeof(real) * M);
  status = add_part(&part, options, dq, dp);
  if (status != OK)
    return status;
  memcpy(first, dq, sizeof(real) * M);
  for (int i = 0; i < M; i++) {
    q[i] = step->q0[i] + (step->carry_q[i] + dq[i]);
    p[i] = step->p0[i] + (step->carry_p[i] + dp[i]);
  }
  part.q0 = q;
  part.p0 = p;
  part.carry_q = part.carry_p = nothing;
  return add_part(&part, options, dq, dp);
}

/* Largest difference of the increments of x relative to the state after the half steps; 0 if it may be rounding. */
static real difference(const real *x, const real *whole, const real *halves)
{
  real largest = 0, most = 0;
  for (int i = 0; i < M; i++)
    largest = larger(largest, MATH(fabs)(x[i]) + MATH(fabs)(halves[i]));
  for (int i = 0; i < M; i++) {
    const real size = MATH(fabs)(x[i]) + MATH(fabs)(halves[i]) + largest + REAL_MIN;
    most = larger(most, MATH(fabs)(whole[i] - halves[i]) / size);
  }
  return most > ROUNDING_OF_HALVES ? most : 0;
}

/* Computes the error of the end of a step relative to the state. Since the step and its halves may both miss forces
 * near the start, e.g. near a centre, a large difference is followed by comparing the first half with its own halves
 * as long as the difference grows. Momenta of the whole step are compared unless dp is NULL. Returns
 * SPURIOUS_SOLUTION if the half steps have no solution or differ by far more than the state. */
static SELDOM int compare_with_halves(const step_data *step, const real *dq, const real *dp,
    const solver_options *options, real *error)
{
  real whole[M], halves[M], changes[M], first[M], before = -1, h = step->h;
  memcpy(whole, dq, sizeof whole);
  *error = 0;
  for (int k = 0; k < MOST_HALVINGS; k++) {
    const int status = solve_halves(step, h, options, halves, changes, first);
    real apart;
    if (status != OK)
      return status > STATUS(SPURIOUS_SOLUTION) ? status : STATUS(SPURIOUS_SOLUTION);
    apart = difference(step->q0, whole, halves);
    *error = larger(*error, apart);
    if (dp && k == 0)
      *error = larger(*error, difference(step->p0, dp, changes));
    if (!(apart <= GROSS_DIFFERENCE))
      return STATUS(SPURIOUS_SOLUTION);
    if (!(apart > RESOLVED_STEP && apart > before))
      break;
    before = apart;
    memcpy(whole, first, sizeof whole);
    h /= 2;
  }
  return OK;
}
