/* A step by Newton's iteration alone. Before it: newton.h, the table EXTRAPOLATION: the guess from the step before is
 * sum_c EXTRAPOLATION[c][b] z_c; for multipliers the rows from B on. */
typedef struct {
  int unused;
} solver_data;

static void prepare(const step_data *step, solver_data *data)
{
  (void)step;
  data->unused = 0;
}

/* The factors at a remembered point, made again, the same to the last bit; 0 if that fails. */
static int remake_factors(const step_data *step, const real *point, const newton_data *data)
{
  const band shape = band_of(SITES, B);
  real size_p[SITES], size_q[M];
  step_data then = *step;
  then.t = point[0];
  then.q0 = point + 1;
  then.carry_q = point + 1 + M;
  memcpy(data->z, point + 1 + 2 * M, sizeof(real) * N);
  evaluate(&then, data->z, data->rows, size_p, size_q, data->factors, &shape);
  return linearise(&then, data, &shape);
}

/* The unknowns of the step before, extrapolated. */
static void guess_from(const real *memory, const newton_data *data)
{
  gather(EXTRAPOLATION[0], B, 1, memory, M, data->z, 1, B);
  gather(EXTRAPOLATION[SITES > M ? B : 0], B, 1, memory + M * B, SITES - M, data->z + M * B, 1, B);
}

/* The increments by RATTLE where a step is one, else by Newton's iteration, from the stages of the step before,
 * extrapolated, and from the straight line if there are none or they lead nowhere. Memory holds the stages, and where
 * factors go from step to step the point of the factors; guess says whether the first (1) or both (2) are of use. */
static int solve(const step_data *step, const solver_data *unused, real *memory, long long *guess, real *dq, real *dp,
    const solver_options *options, solver_report *report, real *workspace)
{
  const newton_data data = newton_in(workspace);
  int status = NOT_CONVERGED, keep = 0;
  (void)unused;
  if (POINT > 0 && *guess == 2)
    keep = step->first ? remake_factors(step, memory + N, &data) : 1;
#ifdef RATTLE
  if (*guess)
    guess_from(memory, &data);
  if (*guess || line_from(step, &data) == OK)
    status = rattle(step, &data, dp, options, report);
  keep = 0;
#endif
  if (status != OK && *guess) {
    guess_from(memory, &data);
    status = newton(step, &data, NULL, NULL, dp, &keep, options, report);
  }
  if (status != OK)
    status = newton_from_line(step, &data, dp, &keep, options, report);
  if (status != OK)
    return status;
  gather(END_POSITION, 1, step->h, data.z, M, dq, 0, 1);
  if (!reaches(step, dq, dp))
    return NOT_FINITE;
  memcpy(memory, data.z, sizeof(real) * N);
  memcpy(memory + N, data.point, sizeof(real) * POINT);
  *guess = POINT > 0 && keep ? 2 : 1;
  return status;
}
