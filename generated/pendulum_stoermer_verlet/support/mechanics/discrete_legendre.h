#ifndef SUPPORT_DISCRETE_LEGENDRE_H
#define SUPPORT_DISCRETE_LEGENDRE_H

/* Discrete Lagrangian of an explicit method (EXPLICIT_STEPS) or of an implicit one (DISCRETE_LAGRANGIAN), with its
 * Legendre transforms; otherwise work and impulses of the forces of a step. */
/* Discrete Lagrangian of the kick-drift-kick scheme (Stoermer-Verlet) and its discrete Legendre transforms. The drift
 * has the velocity (q1 - q0) / h, so that no equations are solved. Requires: splitting.h, energy. */

SELDOM int NAME(discrete_legendre)(real t, real h, const real *q0, const real *q1, const real *parameters,
    const solver_options *options, real *p0, real *p1, real *action, solver_report *report, real *workspace)
{
  const real *ends[2] = {q0, q1};
  real p[M], F[2][M], product = 0, sum = 0, energy;
  (void)options;
  if (report)
    memset(report, 0, sizeof *report);
  mass(NULL, t, parameters, p);
  for (int i = 0; i < M; i++) {
    const real v = (q1[i] - q0[i]) / h;
    p[i] *= v;
    product += p[i] * v;
  }
  for (int n = 0; n < 2; n++) {
    const real then = t + KICK_ABSCISSA[n] * h;
    const int status = NAME(energy)(then, ends[n], p, parameters, &energy, workspace);
    if (status != OK)
      return status;
    force(ends[n], then, parameters, F[n]);
    sum += KICK[n] * (product - energy);
  }
  for (int i = 0; i < M; i++) {
    p0[i] = p[i] - h * KICK[0] * F[0][i];
    p1[i] = p[i] + h * KICK[1] * F[1][i];
  }
  *action = h * sum;
  return all_finite(p0, M) && all_finite(p1, M) && all_finite(action, 1) ? OK : NOT_FINITE;
}

#endif
