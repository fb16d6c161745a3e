#include "step.h"

/* Sizes in which the errors of a step are measured. Neither depends on the origin of a coordinate, but for the rounding
 * of the coordinate itself, and both change with its unit. Per coordinate i and step h:
 *
 * Motion    mu_i = |dq_i| + |h| V_i + h^2 A_i, V_i and A_i the largest |v_i| and |a_i| of the step and, times FORMER_PART
 *           per step, of former ones: at a turning point a step has the size of those around it, and an encounter
 *           does not loosen the rest of a run.
 * Rounding  rho_i = u (|q_i| + |h v_i| + h^2 (|M^-1| F)_i + h^2 (|J| |q|)_i), F_j the sum of the absolute terms of f_j,
 *           J = da/dq, u = REAL_EPSILON / 2. In a contracting iteration h^2 |J| is at most about its rate. The increment
 *           of a step is compensated: its error is rho_i without the first term.
 *
 * The state itself enters nowhere else. Of arrays of run-time sizes V, A and mu are those of a whole array. */

#define FORMER_PART REAL(0.97) /* of the largest velocities and accelerations of former steps: 1/2 after 23 steps */

/* mu_i of the displacement by a step, and by its curvature; V and A of former steps. */
static inline real motion_size(real h, real displacement, real curvature, real v, real a)
{
  const real by_v = MATH(fabs)(h) * v, by_a = h * h * a;
  return displacement + larger(displacement, by_v) + larger(curvature, by_a);
}

/* Rounding error of the displacement of coordinate i by terms of the size of the velocities of all coordinates, which
 * mass matrices couple. */
static inline real rounding_of_displacement(real largest_displacement)
{
  return REAL_EPSILON / 2 * largest_displacement;
}
