#include "../core/numbers.h"

/* Curves of momenta where masses grow. A step represents velocities v and momenta by polynomials of time. Uniform
 * damping at the rate gamma, which is that of the Lagrangian e^(gamma t) L, and masses that depend on time let momenta
 * grow relative to velocities at the rates
 *
 *   r_i = gamma + d log M_ii / dt,  q and v constant,  so that  p_i ~ e^(r_i t) v_i,
 *
 * and either curve may be constant where the other one is not: free fall with damping ends at a constant velocity,
 * which steps of any size represent, while its momentum grows by e^(gamma h) in a step. The error of a step is the
 * larger one of both curves, that of momenta divided by the least factor e^(r_i c h) of the step: there an error of
 * momenta is the largest one of velocities. Requires: real, M, the kernel mass_growth, GROWTH_ABSCISSA and
 * GROWTH_POINTS of the velocities that a step stores, and MASS_ARGUMENT(step, v), the velocity v of a coordinate, or
 * its momentum, on which masses depend. */

#define MOST_GROWN (-MATH(log)(REAL_EPSILON)) /* largest exponent: steps in which masses grow so much have no digit */

/* Velocities v at the points of a step, `apart` numbers for each coordinate, as the curves of momenta. */
static void grow_velocities(const step_data *step, const real *v, int apart, real *grown)
{
  real u[2 * M], growth[M];
  for (int i = 0; i < M; i++)
    u[i] = step->q0[i], u[M + i] = MASS_ARGUMENT(step, v[i * apart], i);
  mass_growth(u, step->t, step->parameters, growth);
  for (int i = 0; i < M; i++) {
    const real rate = is_finite(growth[i]) ? growth[i] * step->h : 0; /* a mass of 0 has none */
    const real first = GROWTH_ABSCISSA[rate > 0 ? 0 : GROWTH_POINTS - 1];
    for (int n = 0; n < GROWTH_POINTS; n++)
      grown[i * apart + n] = v[i * apart + n] * MATH(exp)(smaller(rate * (GROWTH_ABSCISSA[n] - first), MOST_GROWN));
  }
}

/* Largest |r_i h| of a step of displacements dq. */
static inline real growth_of_step(const step_data *step, const real *dq)
{
  real u[2 * M], growth[M], largest = 0;
  for (int i = 0; i < M; i++)
    u[i] = step->q0[i], u[M + i] = MASS_ARGUMENT(step, dq[i] / step->h, i);
  mass_growth(u, step->t, step->parameters, growth);
  for (int i = 0; i < M; i++)
    largest = larger(largest, is_finite(growth[i]) ? MATH(fabs)(growth[i] * step->h) : 0);
  return largest;
}
