#include "../newton/newton_between.h"
#include "jvp_and_vjp.h"

/* Steps between given positions, as intervals of a path: their momenta p0 = -D1 L_d, p1 = D2 L_d and the derivatives of
 * these, the Hessian of L_d (Marsden & West, Acta Numerica 2001, sec. 1.3; with forces, the discrete
 * Lagrange-d'Alembert momenta). The stage equations with the row END_POSITION z = (q1 - q0) / h and the unknown p0 are
 * linearised. Requires: sums_along. */

/* Factorises the Jacobian of a solved step with this row. Returns 0 if it is singular. */
static int linearise_between(linearised_step *at, const real *q1)
{
  real size_p[SITES], size_q[M], *partials = at->partials;
  evaluate(at->step, at->data->z, at->data->rows, size_p, size_q, at->data->factors, &at->shape);
  add_boundary(at->step, at->data, q1, 1, &at->shape);
  if (!factorise(at->data->factors, &at->shape, at->data->pivot))
    return 0;
  for (int f = 0; f < COUNT_OF_GROUPS; f++)
    partials = derivatives_of_group(STAGE_GROUPS + f, at->step, at->data->z, partials);
  return 1;
}

/* From at->v, variations of q0 and h, and those of q1 to the variations of p0 and p1, which replace those of (q0, p0)
 * in at->v. */
static void momenta_between(const linearised_step *at, const real *q1, const wide *varied)
{
  const real h = at->step->h;
  memset(at->rows, 0, sizeof(wide) * SITES * (B + 1));
#ifdef DAMPED
  memset(at->grown, 0, sizeof(wide));
  growth_wide(at->step, 0, at->v, at->grown);
#endif
  through_points(at, 0, at->v, NULL);
  for (int i = 0; i < M; i++) {
    wide *x = at->x + POSITION_IN_MATRIX[i] * (B + 1);
    memcpy(x, at->rows + i * (B + 1), sizeof(wide) * B);
    for (int j = 0; j < WIDTH; j++)
      x[B].lane[j] = (at->v[i].lane[j] - varied[i].lane[j]) / h +
          (q1[i] - at->step->q0[i]) / (h * h) * at->v[INPUT_H].lane[j];
  }
  solve_wide(at->data->factors, &at->shape, at->data->pivot, 0, at->x);
  memset(at->dz, 0, sizeof(wide) * N);
  for (int i = 0; i < M; i++) {
    const wide *x = at->x + POSITION_IN_MATRIX[i] * (B + 1);
    for (int b = 0; b < B; b++)
      for (int j = 0; j < WIDTH; j++)
        at->dz[i * B + b].lane[j] = -x[b].lane[j];
    for (int j = 0; j < WIDTH; j++)
      at->v[i].lane[j] = at->v[M + i].lane[j] = -x[B].lane[j];
  }
  through_points(at, 0, NULL, at->dz);
  end_momentum(at, 0);
}

/* Derivatives of (p0, p1) of a solved step along `count` variations of (q0, q1, h). */
static void derivatives_between(const linearised_step *at, const real *q1, int count, const real *variations,
    real *derivatives)
{
  for (int first = 0; first < count; first += WIDTH) {
    const int own = least(WIDTH, count - first);
    wide varied[M];
    memset(at->v, 0, sizeof(wide) * STEP_INPUTS);
    memset(varied, 0, sizeof varied);
    for (int j = 0; j < own; j++) {
      const real *from = variations + (first + j) * (2 * M + 1);
      for (int i = 0; i < M; i++) {
        at->v[i].lane[j] = from[i];
        varied[i].lane[j] = from[M + i];
      }
      at->v[INPUT_H].lane[j] = from[2 * M];
    }
    momenta_between(at, q1, varied);
    for (int j = 0; j < own; j++)
      for (int i = 0; i < 2 * M; i++)
        derivatives[(first + j) * 2 * M + i] = at->v[i].lane[j];
  }
}

int NAME(steps_between)(long long steps, const real *t, const real *h, const real *q0, const real *q1,
    const real *parameters, long long stride, const solver_options *options, int count, const real *variations,
    real *p0, real *p1, real *action, real *derivatives, solver_report *report, real *workspace)
{
  const real carry[M] = {0};
  memset(report, 0, sizeof *report);
  for (long long k = 0; k < steps; k++) {
    real start_p[M], increment[M], totals[SUMS];
    const step_data step = step_from(t[k], h[k], q0 + k * M, start_p, carry, carry, parameters + k * stride, workspace);
    linearised_step at = linearised_in(&step, workspace);
    report->t = t[k];
    TRY(newton_between(&step, at.data, q1 + k * M, start_p, increment, options ? options : &STANDARD_OPTIONS, report));
    for (int i = 0; i < M; i++) {
      p0[k * M + i] = start_p[i];
      p1[k * M + i] = at.p1[i] = start_p[i] + increment[i];
    }
    sums_along(&step, at.data->z, totals);
    action[k] = totals[SUMS - 1];
    at.shape = band_of(SITES, B + 1);
    if (count > 0 && !linearise_between(&at, q1 + k * M))
      return SINGULAR;
    derivatives_between(&at, q1 + k * M, count, variations, derivatives + k * count * 2 * M);
    if (!all_finite(p0 + k * M, M) || !all_finite(p1 + k * M, M) ||
        !all_finite(derivatives + k * count * 2 * M, count * 2 * M))
      return NOT_FINITE;
    report->steps++;
  }
  return OK;
}
