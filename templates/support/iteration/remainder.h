/* Remainder of the fixed-point iteration of positions at the points, X <- X0 + h^2/m P F(X), extrapolated from the last
 * change dF of the forces. With frozen derivatives F_q it is geometric, and if h^2/m (-F_q) is replaced by its Rayleigh
 * quotient lambda in the direction of the iteration, the forces of the solution are
 *   F + R dF,      R = J + J^2 + .. = J (1 - J)^-1,      J = -lambda P.
 * The eigenvalues of P are complex: a rate that is one number extrapolates to the wrong side. With the characteristic
 * polynomial det(1 + lambda P) = 1 + sum_k d_k lambda^k and the adjugate of 1 + lambda P (Faddeev-LeVerrier), the
 * products of the end weights b with R are b^T R = sum_k lambda^k r_k / det, with tables r_k of the method. Without it
 * the remainder, although below rounding, has the same sign in every period of an oscillation, and energies drift.
 * Requires: points.h or trajectories.h, the tables REMAINDER_*, LARGEST_STIFFNESS. */
#define FIRST_ORDER 0.01 /* part of the largest lambda below which R = J is as good */

/* b^T R at the points, for the end weights of positions and momenta. */
typedef struct {
  lanes position[GROUPS], momentum[GROUPS];
} remainder_weights;

/* lambda = -sum w h^2/m dF dX / sum w dX^2 for weights w, bounded so that the remainder exists; 0 without a change. */
static inline number find_stiffness(number work, number size)
{
  return bounded_ratio(-work, size, LARGEST_STIFFNESS);
}

/* Weights of dF in the increments: those of positions as their end weights, those of momenta times h. */
static inline void weigh_remainder(number stiffness, real h, remainder_weights *of)
{
  number inverse = number_of(0.0);
  if (is_within(stiffness, FIRST_ORDER * LARGEST_STIFFNESS)) {
    for (int g = 0; g < GROUPS; g++) {
      of->position[g] = stiffness * TABLE_ENTRY(REMAINDER_POSITION, g, 0);
      of->momentum[g] = h * stiffness * TABLE_ENTRY(REMAINDER_MOMENTUM, g, 0);
    }
    return;
  }
  for (int k = TERMS - 1; k >= 0; k--)
    inverse = stiffness * (inverse + VECTOR_ENTRY(REMAINDER_DETERMINANT, k));
  inverse = 1.0 / (1.0 + inverse);
  for (int g = 0; g < GROUPS; g++) {
    lanes position = lanes_of(0.0), momentum = lanes_of(0.0);
    for (int k = TERMS - 1; k >= 0; k--) {
      position = stiffness * (position + TABLE_ENTRY(REMAINDER_POSITION, g, k));
      momentum = stiffness * (momentum + TABLE_ENTRY(REMAINDER_MOMENTUM, g, k));
    }
    of->position[g] = inverse * position;
    of->momentum[g] = h * inverse * momentum;
  }
}
