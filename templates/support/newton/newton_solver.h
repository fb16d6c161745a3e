#include "newton_from_line.h"
#include "stages.h"
#include "suspension.h"

/* Step by Newton's method. Requires: the table EXTRAPOLATION: the predictor is sum_c EXTRAPOLATION[c][b] z_c of the
 * previous step; for multipliers the rows from B on. */
typedef struct {
  int rattle_alone; /* 1 if a step whose iteration of the multipliers fails is not solved by Newton's method */
  int is_pilot; /* 1 in the search for the first step on constraints: of which only contraction is asked */
#ifdef RATTLE
  rattle_data rattle;
#endif
} solver_data;

static void prepare(const step_data *step, solver_data *data)
{
  data->rattle_alone = data->is_pilot = 0;
#ifdef RATTLE
  prepare_rattle(step, &data->rattle);
#ifdef RATTLE_IN_PAIRS
  if (step->points)
    invert_mass_pairs(step, data->rattle.inverse_mass, ((solved_step *)step->points)->inverse_mass);
#endif
#endif
}

/* Recomputes the factors at a stored point, bit for bit; returns 0 if that fails. */
static int remake_factors(const step_data *step, const real *point, newton_data *data)
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

/* Extrapolates the unknowns of the previous step. */
static void guess_from(const real *memory, newton_data *data)
{
  gather(EXTRAPOLATION[0], B, 1, memory, M, data->z, 1, B);
  gather(EXTRAPOLATION[SITES > M ? B : 0], B, 1, memory + M * B, SITES - M, data->z + M * B, 1, B);
}

#ifdef FIRST_ORDER_SYSTEM
/* Replaces the increments of the momenta theta(q, y) by those of y: solves theta(q1, y1) = theta0 + dtheta by Newton
 * iteration from y at the last point of the step. */
static int variables_of_momenta(const step_data *step, const real *z, const real *dq, real *increment)
{
  real u[2 * M], theta[M];
  for (int i = 0; i < M; i++) {
    u[i] = step->q0[i] + (step->carry_q[i] + dq[i]);
    u[M + i] = z[i * B + B - 1];
    theta[i] = step->theta0[i] + increment[i];
  }
  TRY(invert_from(step->t + step->h, u, theta, step->parameters, step->scratch));
  for (int i = 0; i < M; i++)
    increment[i] = (u[M + i] - step->p0[i]) - step->carry_p[i];
  return OK;
}
#endif

/* Computes the increments by RATTLE if applicable, else by Newton's method from the extrapolated stages of the previous
 * step, and from the straight line if there are none or the iteration fails. memory contains the stages and, if factors
 * are reused, the point of the factors; guess is 1 if the stages are valid, 2 if both are, and negative if they are
 * after a step that RATTLE did not solve (suspension.h). On failure the increments are undefined and memory and guess
 * are unchanged. */
static int solve(const step_data *step, const solver_data *way, real *memory, long long *guess, real *dq, real *dp,
    const solver_options *options, solver_report *report, real *workspace)
{
  newton_data *data = newton_in(workspace);
  int status = NOT_CONVERGED, keep = 0, falls_back = 0;
#ifdef FIRST_ORDER_SYSTEM
  real theta[M];
  step_data with_momenta = *step;
  TRY(transform(step->t, step->q0, step->p0, step->parameters, theta, step->scratch));
  with_momenta.theta0 = theta;
  step = &with_momenta;
#endif
  if (POINT > 0 && *guess == 2)
    keep = step->first ? remake_factors(step, memory + N, data) : 1;
#ifdef RATTLE
#ifdef RATTLE_IN_PAIRS
  if (step->points)
    ((solved_step *)step->points)->by_rattle = 0;
#endif
  if (!is_suspended(*guess))
    status = rattle(step, &way->rattle, *guess ? memory : NULL, data, dp, options, report);
  keep = 0;
  falls_back = status != OK;
  if (falls_back && status != LOST_DIGITS && way->rattle_alone)
    return status;
#endif
  if (status != OK && *guess) {
    guess_from(memory, data);
    status = newton(step, data, NULL, NULL, dp, &keep, options, report);
  }
  if (status != OK)
    TRY((way->is_pilot ? newton_on_line : newton_from_line)(step, data, dp, &keep, options, report));
  gather(END_POSITION, 1, step->h, data->z, M, dq, 0, 1);
#ifdef FIRST_ORDER_SYSTEM
  TRY(variables_of_momenta(step, data->z, dq, dp));
#endif
  TRY(reaches(step, dq, dp) ? OK : NOT_FINITE);
  report->fallback_steps += falls_back;
  memcpy(memory, data->z, sizeof(real) * N);
  memcpy(memory + N, data->point, sizeof(real) * POINT);
  *guess = falls_back ? after_fallback(*guess) : POINT > 0 && keep ? 2
                                                                   : 1;
  return OK;
}
