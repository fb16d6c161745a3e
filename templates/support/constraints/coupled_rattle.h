#include "multiplier_iteration.h"

/* Constrained steps on Lobatto points for mass matrices M(q, t) that depend on positions, and for uniform damping,
 * whose factors e^(gamma c_n h) multiply the values at point n. Unknowns are the velocities v and multipliers lambda
 * at all points but the last. With the momenta p = L_v at all points, positions and residuals are
 *
 *   u = q0 + h D v,    r = p0 + h I (F + G^T lambda) - m p,
 *
 * D = RATTLE_DISPLACEMENT, I = RATTLE_IMPULSE, m = RATTLE_MEAN, F = L_q + f. With y = M^-1 r and P = G M^-1 G^T, whose
 * matrices M and G are those of each point, an iteration subtracts x from lambda,
 *
 *   P x = (D I)^-1 (g + h G D y) / h^2,    v += y - h M^-1 I G^T x,
 *
 * which neglects that M and G vary between the points and that F varies, errors of order h. Unconstrained systems have
 * the same iteration without multipliers (coupled_iteration.h).
 *
 * Requires: multiplier_iteration.h with what it requires, MASSES_OF_POINTS, the kernel constrained_point of L_q + f
 * and L_v, with the lower half of M, LOWER_MASS_ENTRY; MASS_REACH of M in the order MASS_POSITION; if DAMPED,
 * damping.h; the tables RATTLE_ABSCISSA, RATTLE_WEIGHT; RATTLE_DISPLACEMENT, RATTLE_IMPULSE, RATTLE_MEAN and, of the
 * last point, RATTLE_MEAN_OF_LAST with their low words; RATTLE_INVERSE of D I; RATTLE_LAST_VELOCITY, from v to the
 * velocity at the last point, RATTLE_UNKNOWNS, to the unknowns of the step, and from these RATTLE_VELOCITIES and
 * RATTLE_MULTIPLIERS of the next one, padded with zeros. */

/* Constants of a step size: the factors of the points, e^(-gamma h), and e^(-gamma h) - 1. */
typedef struct {
  real grown[POINT_LANES + 1], shrunk, loss;
} rattle_data;

static void prepare_rattle(const step_data *step, rattle_data *data)
{
#ifdef DAMPED
  const real growth = growth_of(step);
  for (int n = 0; n <= POINT_LANES; n++)
    data->grown[n] = MATH(exp)(growth * RATTLE_ABSCISSA[n]);
  data->shrunk = MATH(exp)(-growth);
  data->loss = MATH(expm1)(-growth);
#endif
}

#ifdef DAMPED
#define GROWN(now, g) load((now)->run->grown, g)
#else
#define GROWN(now, g) 1
#endif

/* Positions u, derivatives G and g at all points but the first, where G is first_derivative; positions `at`,
 * velocities, forces, momenta, masses and multipliers at all but the last, where force and momentum are last_force and
 * last_p. With f, y and c the right-hand sides of an iteration; base and base_p, q0 and p0 with the effect of low
 * words; at the end M^-1, end_mass and end_inverse, and L_v at v = 0, end_rest. */
typedef struct {
  number u[M][GROUP_LANES], v[M][GROUP_LANES], force[M][GROUP_LANES], derivative[CONSTRAINT_ENTRIES][GROUP_LANES];
  lanes lambda[CONSTRAINTS][GROUPS];
  number last_force[M];
  number g[CONSTRAINTS][GROUP_LANES], at[M][GROUP_LANES], p[M][GROUP_LANES]; /* from here on not part of the solution */
  number mass[LOWER_MASSES][GROUP_LANES], first_derivative[CONSTRAINT_ENTRIES], last_p[M];
  number f[M][GROUP_LANES], y[M][GROUP_LANES], c[CONSTRAINTS][GROUP_LANES];
  lanes base[M][GROUPS], base_p[M][GROUPS];
  inverse_masses inverse_mass[GROUPS], end_mass;
  number end_inverse[INVERSE_MASSES], end_rest[M];
  const rattle_data *run;
} rattle_step;

/* Inverts the masses of a group of points; not finite if they are singular. Coordinates that no masses couple share a
 * solution. */
static inline void invert(const lanes *mass, inverse_masses inverse)
{
  lanes l[M * (MASS_REACH + 1)] = {{0}}, x[M];
#pragma GCC unroll 64
  for (int e = 0; e < LOWER_MASSES; e++) {
    const int i = MASS_POSITION[LOWER_MASS_ENTRY[e][0]], j = MASS_POSITION[LOWER_MASS_ENTRY[e][1]];
    l[MASS_REACH + (i > j ? i * MASS_REACH + j : j * MASS_REACH + i)] = mass[e];
  }
  factorise_symmetric(l, M, MASS_REACH, MASS_REACH);
  for (int column = 0; column < MASS_COLUMNS; column++) {
    for (int i = 0; i < M; i++)
      x[MASS_POSITION[i]] = lanes_of(MASS_COLUMN[i] == column);
    solve_symmetric(l, M, MASS_REACH, MASS_REACH, x);
#pragma GCC unroll 64
    for (int e = 0; e < INVERSE_MASSES; e++)
      if (MASS_COLUMN[INVERSE_MASS_ENTRY[e][1]] == column)
        inverse[e] = x[MASS_POSITION[INVERSE_MASS_ENTRY[e][0]]];
  }
}

/* Inverts the masses of a group of points, except where the inverses are kept. */
static inline void invert_masses(condition kept, rattle_step *now, int g)
{
  lanes mass[LOWER_MASSES];
  if (all_of(kept))
    return;
#pragma GCC unroll 64
  for (int e = 0; e < LOWER_MASSES; e++)
    mass[e] = load(now->mass[e], g);
#ifdef TRAJECTORIES_AS_LANES
  inverse_masses renewed;
  invert(mass, renewed);
  for (int e = 0; e < INVERSE_MASSES; e++)
    now->inverse_mass[g][e] = where(kept, now->inverse_mass[g][e], renewed[e]);
#else
  invert(mass, now->inverse_mass[g]);
#endif
}

/* Evaluates the last point. */
static inline void evaluate_last(const step_data *step, rattle_step *now)
{
  number u[2 * M] = {0}, value[2 * M], mass[LOWER_MASSES];
  for (int i = 0; i < M; i++) {
    u[i] = now->u[i][DEGREE - 1];
    for (int n = 0; n < DEGREE; n++)
      u[M + i] += RATTLE_LAST_VELOCITY[n] * now->v[i][n];
  }
  constrained_point(u, step->t + RATTLE_ABSCISSA[DEGREE] * step->h, step->parameters, value, mass);
  for (int i = 0; i < M; i++) {
    now->last_force[i] = value[i];
    now->last_p[i] = value[M + i];
#ifdef DAMPED
    now->last_force[i] *= now->run->grown[DEGREE];
    now->last_p[i] *= now->run->grown[DEGREE];
#endif
  }
}

/* Evaluates forces, momenta, masses, constraints and their derivatives. */
static __attribute__((flatten)) void evaluate_points(const step_data *step, rattle_step *restrict now)
{
  for (int i = 0; i < M; i++)
    for (int g = 0; g < GROUPS; g++)
      store(now->at[i], g, former(now->u[i], step->q0[i], g));
  for (int n = 0; n < GROUP_LANES; n++) {
    number u[2 * M], value[2 * M], mass[LOWER_MASSES];
    TAKE_LANE(u, M, now->at, n);
    TAKE_LANE(u + M, M, now->v, n);
    constrained_point(u, step->t + RATTLE_ABSCISSA[n] * step->h, step->parameters, value, mass);
    PUT_LANE(now->force, M, n, value);
    PUT_LANE(now->p, M, n, value + M);
    PUT_LANE(now->mass, LOWER_MASSES, n, mass);
  }
  for (int n = 0; n < GROUP_LANES; n++) {
    number u[M], g[CONSTRAINTS], derivative[CONSTRAINT_ENTRIES];
    TAKE_LANE(u, M, now->u, n);
    constraints(u, step->t + RATTLE_ABSCISSA[n + 1] * step->h, step->parameters, g, derivative);
    PUT_LANE(now->g, CONSTRAINTS, n, g);
    PUT_LANE(now->derivative, CONSTRAINT_ENTRIES, n, derivative);
  }
  evaluate_last(step, now);
#ifdef DAMPED
  for (int i = 0; i < M; i++)
    for (int g = 0; g < GROUPS; g++) {
      store(now->force[i], g, load(now->force[i], g) * GROWN(now, g));
      store(now->p[i], g, load(now->p[i], g) * GROWN(now, g));
    }
#endif
}

#include "iterate.h"

/* Sizes of the terms of the displacements, with reactions if requested. */
static inline void term_sizes(const step_data *step, rattle_step *now, int reactions, number *size)
{
  number force[M], inverse_mass[INVERSE_MASSES];
  TAKE_LANE(force, M, now->force, 0);
#pragma GCC unroll 64
  for (int e = 0; e < INVERSE_MASSES; e++)
    inverse_mass[e] = FIRST_LANE(now->inverse_mass[0][e]);
  find_term_sizes(step, force, now->first_derivative, reactions ? now->lambda : NULL, inverse_mass, size);
}

/* Initial values: the first point, and a guess of the others from the unknowns of the previous step, or if they are
 * NULL motion without forces of the velocities `start`. The low words of the tables act on the guess. */
static void begin(const step_data *step, const rattle_data *run, const number *memory, const number *start,
    rattle_step *now)
{
  number constraint[CONSTRAINTS];
  now->run = run;
  constraints(step->q0, step->t, step->parameters, constraint, now->first_derivative);
  for (int i = 0; i < M; i++)
    for (int g = 0; g < GROUPS; g++)
      store(now->v[i], g, memory ? times(RATTLE_VELOCITIES, B, memory + i * B, g) : lanes_of_number(start[i]));
  IN_MEMORY(now->v);
  begin_positions(step, now);
  for (int k = 0; k < CONSTRAINTS; k++)
    for (int g = 0; g < GROUPS; g++)
      now->lambda[k][g] = memory ? times(RATTLE_MULTIPLIERS, B, memory + (M + k) * B, g) : lanes_of(0);
  evaluate_points(step, now);
  begin_momenta(step, now);
}

/* Velocities z of the curve, p1 - p0 before the projection, and the masses at the end. */
static inline void finish_curve(const step_data *step, rattle_step *now, number *velocities, number *dp)
{
  number z[M][GROUP_LANES], u[2 * M] = {0}, value[2 * M], mass[LOWER_MASSES];
  lanes end_mass[LOWER_MASSES];
  finish_points(step, now, z);
  for (int i = 0; i < M; i++) {
    number sum = RATTLE_WEIGHT[DEGREE] * now->last_force[i];
    memcpy(velocities + i * B, z[i], sizeof(number) * DEGREE);
    for (int n = 0; n < DEGREE; n++)
      sum += RATTLE_WEIGHT[n] * now->f[i][n];
    dp[i] = step->h * sum;
#ifdef DAMPED
    dp[i] = now->run->shrunk * dp[i] + now->run->loss * (step->p0[i] + step->carry_p[i]);
#endif
    u[i] = now->u[i][DEGREE - 1];
  }
  constrained_point(u, step->t + step->h, step->parameters, value, mass);
  memcpy(now->end_rest, value + M, sizeof now->end_rest);
#pragma GCC unroll 64
  for (int e = 0; e < LOWER_MASSES; e++)
    end_mass[e] = lanes_of_number(mass[e]);
  invert(end_mass, now->end_mass);
#pragma GCC unroll 64
  for (int e = 0; e < INVERSE_MASSES; e++)
    now->end_inverse[e] = FIRST_LANE(now->end_mass[e]);
}

#define END_MASSES(now) (now)->end_mass /* inverted, at the end */

/* Velocities at the end, where the momenta are p0 + dp. */
static inline void end_velocity(const step_data *step, const rattle_step *now, const number *dp, number *v)
{
  number p[M];
  for (int i = 0; i < M; i++)
    p[i] = (step->p0[i] - now->end_rest[i]) + dp[i];
  find_velocities(now->end_inverse, p, v);
}
