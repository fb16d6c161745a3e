#include "../arrays/array_memory.h"
#include "constraint_projection.h"

/* Functions of states on the constraints of arrays: projection, distances, values and multipliers. */

#define REFINEMENTS 3
#define REFINED 1e-6 /* reduction of the residual per refinement */
#define ROUNDED_NEAR_ORIGIN (1024 * DBL_EPSILON) /* positions that are 0 but for rounding, as in constraints.h .. */
#define LITTLE_NEAR_ORIGIN 1e-6 /* .. differ at most by this */

/* Starts a run at a state with these parameters. */
static int start_at(run_memory *run, double t, const double *q, const double *p, const double *parameters)
{
  NAME(start)(run, t, 0.0, q, p);
  return use_parameters(run, parameters);
}

int NAME(project)(double t, const double *q0, const double *p0, const double *parameters, double *q1, double *p1,
    double *workspace)
{
  run_memory *run = run_in(workspace);
  const size_t size = sizeof(double) * (size_t)coordinates_of(&run->data);
  solver_report report = {0};
  int status = start_at(run, t, q0, p0, parameters);
  if (status == OK)
    status = project_run(run, &report, 1);
  memcpy(q1, run->q, size);
  memcpy(p1, run->p, size);
  return status;
}

/* Largest difference of two vectors, and their largest number. */
static double distance(const double *x, const double *y, long long n, double *size)
{
  double apart = 0.0;
  *size = 0.0;
  for (long long i = 0; i < n; i++) {
    *size = larger(*size, larger(fabs(x[i]), fabs(y[i])));
    apart = larger(apart, fabs(y[i] - x[i]));
  }
  return apart;
}

int NAME(apart)(double t, const double *q0, const double *p0, const double *q1, const double *p1,
    const double *parameters, double *apart, double *workspace)
{
  const long long n = coordinates_of(&run_in(workspace)->data);
  double size[2];
  apart[0] = distance(q0, q1, n, &size[0]);
  apart[1] = distance(p0, p1, n, &size[1]);
  if (apart[0] <= ROUNDED_NEAR_ORIGIN && apart[0] > LITTLE_NEAR_ORIGIN * size[0])
    size[0] = apart[0] / LITTLE_NEAR_ORIGIN;
  for (int k = 0; k < 2; k++)
    apart[k] /= size[k] > 0.0 ? size[k] : 1.0;
  return OK;
}

static void values_of_run(run_memory *run, double *g, double *rate)
{
  const constrained_run of = constrained_run_of(run, NULL, NULL);
  evaluate_constraints(&run->data, run->q, run->t, g, rate, of.held.next);
  for (long long k = 0; k < of.held.count; k++)
    for (int e = of.held.of.first[k]; e < of.held.of.first[k + 1]; e++) {
      const int i = of.held.of.place[e];
      rate[k] += of.held.next[e] * (run->inverse_mass[i] * run->p[i]);
    }
}

/* Multipliers from G M^-1 (F + G^T lambda) = -d^2 g / dt^2 at constant velocity. The predictor of the next step is not
 * changed. */
static int multipliers_of_run(run_memory *run, double *lambda)
{
  solver_report report = {0};
  const constrained_run of = constrained_run_of(run, NULL, &report);
  const constraint_system *held = &of.held;
  double *F = of.work.D, *pulled = of.work.Y;
  if (!run->guess)
    TRY(begin(&of));
  find_forces(&of, run->q, NULL, run->t, F);
  for (long long i = 0; i < of.n; i++)
    pulled[i] = run->inverse_mass[i] * run->p[i];
  compute_second_derivatives(&run->data, run->q, pulled, run->t, held->g);
  memset(lambda, 0, sizeof(double) * (size_t)held->count);
  for (int round = 0; round < REFINEMENTS; round++) {
    compute_constraint_forces(held, lambda, of.work.R, of.n);
    for (long long i = 0; i < of.n; i++)
      pulled[i] = run->inverse_mass[i] * (F[i] + of.work.R[i]);
    find_right(held, held->g, pulled, 1.0);
    for (long long i = 0; i < of.n; i++)
      pulled[i] = run->inverse_mass[i] * (fabs(F[i]) + fabs(of.work.R[i]));
    compute_rounding(held, held->derivative, pulled, 1.0);
    TRY(solve_constraint_system(held, REFINED, &report));
    add_to(lambda, held->change, 1.0, held->count);
  }
  return OK;
}

int NAME(constraint_values)(long long count, const double *t, const double *q, const double *p,
    const double *parameters, double *g, double *rate, double *workspace)
{
  run_memory *run = run_in(workspace);
  const long long n = coordinates_of(&run->data), m = run->constraints;
  for (long long k = 0; k < count; k++) {
    TRY(start_at(run, t[k], q + k * n, p + k * n, parameters));
    values_of_run(run, g + k * m, rate + k * m);
  }
  return OK;
}

int NAME(multipliers)(long long count, const double *t, const double *q, const double *p, const double *parameters,
    double *multiplier, double *workspace)
{
  run_memory *run = run_in(workspace);
  const long long n = coordinates_of(&run->data), m = run->constraints;
  for (long long k = 0; k < count; k++) {
    TRY(start_at(run, t[k], q + k * n, p + k * n, parameters));
    TRY(multipliers_of_run(run, multiplier + k * m));
  }
  return OK;
}
