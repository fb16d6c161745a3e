#include "multiplier_iteration.h"

/* Sizes by which the iteration of a constrained step ends, and the end of the step. Requires: rattle.h or
 * coupled_rattle.h, the kernels constraint_rounding and constrained_motion. */
#define MULTIPLIERS_KNOWN 1 /* iteration whose multipliers show the sizes of reactions */

/* Sizes of positions, inverted, and the largest one; widened: of their terms without reactions, and of those of g. */
typedef struct {
  number inverse[M], largest;
  int widened;
} unknown_sizes;

static inline void find_sizes(const step_data *step, rattle_step *now, unknown_sizes *sizes)
{
  term_sizes(step, now, 1, sizes->inverse);
  sizes->largest = invert_sizes(sizes->inverse);
}

/* Where forces and reactions may lose digits: of a body so light that they move it in a step by much more than
 * it moves, rounding errors of its position are relative to them. In Newton's method positions are unknowns. */
static inline condition may_lose_digits(const step_data *step, const rattle_step *now, const number *inverse_size)
{
  condition may = {0};
  for (int i = 0; i < M; i++) {
    const number moved = magnitude(step->q0[i]) + magnitude(now->u[i][DEGREE - 1] - step->q0[i]);
    may |= (condition)((2 * moved + REAL_MIN) * inverse_size[i] < 1);
  }
  return may;
}

/* Where they do: reactions exceed momenta and forces, as of light bodies, and displacements that change a
 * constraint by the size of its terms. A coordinate may be held at 0. Replaces the sizes, if they are not NULL. */
static SELDOM __attribute__((noinline)) condition loses_digits(const step_data *step, rattle_step *now,
    unknown_sizes *sizes)
{
  number size[M], length[M] = {0}, rounding[CONSTRAINTS];
  unknown_sizes of_reactions = {.widened = 0};
  condition loses = {0};
  find_sizes(step, now, &of_reactions);
  if (sizes)
    *sizes = of_reactions;
  term_sizes(step, now, 0, size);
  constraint_rounding(step->q0, step->t, step->parameters, rounding);
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++) {
    const int k = CONSTRAINT_ENTRY[e][0], i = CONSTRAINT_ENTRY[e][1];
    length[i] = larger_number(length[i], rounding[k] / magnitude(now->first_derivative[e]));
  }
  for (int i = 0; i < M; i++)
    loses |= (condition)(larger_number(LARGEST_REACTION * size[i], length[i]) * of_reactions.inverse[i] < 1);
  return loses;
}

/* Computes p1 - p0 on the tangent space, and the unknowns z of the step. An unrolled loop keeps dp
 * in registers: a vector that is loaded soon after its parts were stored waits for them. */
static void finish_step(const step_data *step, rattle_step *now, number *z, number *dp)
{
  const real last_weight = step->h * RATTLE_WEIGHT[DEGREE];
  factors l;
  lanes derivative[CONSTRAINT_ENTRIES], x[CONSTRAINTS];
  number u[2 * M], value[M + 2 * CONSTRAINTS];
  finish_curve(step, now, z, dp);
  TAKE_LANE(u, M, now->u, DEGREE - 1);
  end_velocity(step, now, dp, u + M);
  constrained_motion(u, step->t + step->h, step->parameters, value);
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++)
    derivative[e] = load(now->derivative[e], LAST_GROUP);
  factorise_points(derivative, END_MASSES(now), l);
  for (int k = 0; k < CONSTRAINTS; k++)
    x[CONSTRAINT_POSITION[k]] = lanes_of_number(-value[M + k] / last_weight);
  solve_points(l, x);
#pragma GCC unroll 64
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++)
    dp[CONSTRAINT_ENTRY[e][1]] += last_weight * now->derivative[e][DEGREE - 1] *
        LAST_LANE(x[CONSTRAINT_POSITION[CONSTRAINT_ENTRY[e][0]]]);
  end_velocity(step, now, dp, u);
  for (int i = 0; i < M; i++)
    z[i * B + DEGREE] = u[i];
  for (int k = 0; k < CONSTRAINTS; k++) {
    memcpy(z + (M + k) * B, now->lambda + k, sizeof(number) * DEGREE);
    z[(M + k) * B + DEGREE] = LAST_LANE(x[CONSTRAINT_POSITION[k]]);
  }
}
