#include "../iteration/coupled_iteration.h"
#include "mixed_newton.h"
#include "pair_sums.h"

/* Step in double-double arithmetic by mixed precision, of any regular Lagrangian. coupled_iteration.h solves the stage
 * equations in double, to 1e-16. With its tables, A (positions from velocities) and W (momenta from forces), their
 * residual in pairs, R = p0 + h W L_q(q, z) - L_v(q, z), q = q0 + h A z, has 16 digits as one word. The correction D of
 * the velocities,
 *   L_vv D = R + h W f - L_vq x,    x = h A D,    f = L_qq x + L_qv D,
 * is solved in double by fixed-point iteration with the derivatives at the solution in double, to half the digits; what
 * it leaves, and what is quadratic in D, is the residual at the corrected points, whose correction is small enough to
 * be linear: two evaluations in pairs are enough. The tables and the weights h beta, h w have two words, rounded once,
 * so that the map of a variational method has a generating function, as in double. Requires: the kernels
 * value_lanes_pairs (L_q, L_v), point_derivatives and derivative_product; low words of the tables. */

#define LINEAR_CORRECTION 1e-20 /* relative to the velocities: what it omits is below 1e-35 */
#define CORRECTED_PART 1e-9 /* last change of a correction, relative to its residual */
#define CORRECTED_VELOCITIES 1e-35 /* the same relative to the velocities */
#define MOST_EVALUATIONS 6
#define MOST_LINEAR_ITERATIONS 100
#define SMALLEST_VELOCITY 1e-280 /* 1e15 times its inverse is finite */

/* Arguments of a step, and its points. */
typedef struct {
  dd t, h, q0[M], p0[M];
  const double *parameters;
  double inverse_size[M];
  ddl position_weight[GROUPS], momentum_weight[GROUPS]; /* h beta, h w */
  ddl q[GROUPS][M], z[GROUPS][M], F[GROUPS][M];
  lanes rest[GROUPS][M], mass[GROUPS][MASS]; /* R; factors of L_vv */
  lanes vector[GROUPS][2 * M + POINT_DERIVATIVES]; /* x, D, then the derivatives */
} velocity_pairs;

static inline ddl time_of_points(const velocity_pairs *at, int n)
{
  return ddl_add(ddl_of(at->t), ddl_multiply(ddl_of_words(ABSCISSA[n], ABSCISSA_LOW[n]), ddl_of(at->h)));
}

static void begin_velocity_pairs(const step_data *step, double t_low, double h_low, velocity_pairs *at)
{
  const solved_step *solved = (const solved_step *)step->points;
  at->t = dd_of(step->t, t_low);
  at->h = dd_of(step->h, h_low);
  at->parameters = step->parameters;
  for (int n = 0; n < GROUPS; n++) {
    at->position_weight[n] = ddl_multiply(ddl_of(at->h), ddl_of_words(POSITION_WEIGHT[n], POSITION_WEIGHT_LOW[n]));
    at->momentum_weight[n] = ddl_multiply(ddl_of(at->h), ddl_of_words(MOMENTUM_WEIGHT[n], MOMENTUM_WEIGHT_LOW[n]));
  }
  for (int i = 0; i < M; i++) {
    double size = 0.0;
    at->q0[i] = dd_of(step->q0[i], step->carry_q[i]);
    at->p0[i] = dd_of(step->p0[i], step->carry_p[i]);
    for (int n = 0; n < GROUPS; n++) {
      at->z[n][i] = ddl_word(solved->z[n][i]);
      for (int j = 0; j < LANES; j++)
        size = larger(size, fabs(lane_of(&solved->z[n][i], j)));
    }
    at->inverse_size[i] = size;
  }
  const double largest = largest_number(at->inverse_size);
  for (int i = 0; i < M; i++)
    at->inverse_size[i] = 1.0 / (at->inverse_size[i] + 1e-3 * largest + SMALLEST_VELOCITY);
}

static inline void weigh_pairs(const ddl *weight, ddl (*x)[M], ddl (*scaled)[M])
{
  for (int n = 0; n < GROUPS; n++)
    for (int i = 0; i < M; i++)
      scaled[n][i] = ddl_multiply(weight[n], x[n][i]);
}

/* Computes positions, forces and the residual. */
static void find_velocity_residual(velocity_pairs *at)
{
  ddl scaled[GROUPS][M], momentum[GROUPS][M];
  weigh_pairs(at->position_weight, at->z, scaled);
  for (int n = 0; n < GROUPS; n++) {
    ddl u[2 * M], value[2 * M];
    for (int i = 0; i < M; i++) {
      u[i] = at->q[n][i] = ddl_add(ddl_of(at->q0[i]), sum_of_pairs(POSITION, POSITION_LOW, n, scaled, i));
      u[M + i] = at->z[n][i];
    }
    value_lanes_pairs(u, time_of_points(at, n), at->parameters, value);
    memcpy(at->F[n], value, sizeof at->F[n]);
    memcpy(momentum[n], value + M, sizeof momentum[n]);
  }
  weigh_pairs(at->momentum_weight, at->F, scaled);
  for (int n = 0; n < GROUPS; n++)
    for (int i = 0; i < M; i++) {
      const ddl P = ddl_add(ddl_of(at->p0[i]), sum_of_pairs(MOMENTUM, MOMENTUM_LOW, n, scaled, i));
      at->rest[n][i] = ddl_subtract(P, momentum[n][i]).high;
    }
}

static void find_velocity_derivatives(velocity_pairs *at)
{
  memset(at->mass, 0, sizeof at->mass);
  for (int n = 0; n < GROUPS; n++) {
    lanes u[2 * M], value[M + POINT_DERIVATIVES];
    for (int i = 0; i < M; i++) {
      u[i] = at->q[n][i].high;
      u[M + i] = at->z[n][i].high;
    }
    point_derivatives(u, at->t.high + at->h.high * ABSCISSA[n], at->parameters, value, at->mass[n]);
    factor_mass(at->mass[n]);
    memcpy(at->vector[n] + 2 * M, value + M, sizeof(lanes) * POINT_DERIVATIVES);
  }
}

/* Solves for D and x, and for f, the changes of forces and, times -1, of momenta; returns the size of D, or NaN on
 * failure. */
static double find_velocity_correction(velocity_pairs *at, lanes (*f)[2 * M])
{
  lanes total[GROUPS] = {{0.0}}, scaled[GROUPS][M], impulse[GROUPS][M];
  double size, last, least;
  for (int n = 0; n < GROUPS; n++) {
    lanes *D = at->vector[n] + M;
    memcpy(D, at->rest[n], sizeof at->rest[n]);
    solve_mass(at->mass[n], D);
    for (int i = 0; i < M; i++) {
      const lanes part = D[i] * (1e15 * at->inverse_size[i]); /* squares are normal */
      total[n] += part * part;
    }
  }
  size = last = sqrt(points_total(total)) / 1e15;
  least = size <= LINEAR_CORRECTION ? CORRECTED_VELOCITIES : larger(CORRECTED_PART * size, CORRECTED_VELOCITIES);
  for (int k = 0; k < MOST_LINEAR_ITERATIONS; k++) {
    lanes moved[GROUPS] = {{0.0}};
    for (int n = 0; n < GROUPS; n++)
      for (int i = 0; i < M; i++)
        scaled[n][i] = at->position_weight[n].high * at->vector[n][M + i];
    for (int n = 0; n < GROUPS; n++) {
      for (int i = 0; i < M; i++)
        at->vector[n][i] = apply(POSITION, n, scaled, i);
      derivative_product(at->vector[n], lanes_of(at->t.high), at->parameters, f[n]);
      for (int i = 0; i < M; i++)
        impulse[n][i] = at->momentum_weight[n].high * f[n][i];
    }
    for (int n = 0; n < GROUPS; n++) {
      lanes next[M];
      for (int i = 0; i < M; i++)
        next[i] = at->rest[n][i] + apply(MOMENTUM, n, impulse, i) + f[n][M + i];
      solve_mass(at->mass[n], next);
      for (int i = 0; i < M; i++) {
        const lanes change_of_D = (next[i] - at->vector[n][M + i]) * (1e15 * at->inverse_size[i]);
        moved[n] += change_of_D * change_of_D;
        at->vector[n][M + i] = next[i];
      }
    }
    const double change = sqrt(points_total(moved)) / 1e15, rate = change / last;
    if (!is_finite(change))
      return NAN;
    if (change <= least || (rate < 0.5 && change * rate <= least))
      return size;
    last = change;
  }
  return NAN;
}

#ifdef TIME_TRANSFORMATION
/* h sum_n w_n g along the curve, the time that passes in a step of tau. */
static dd duration_of_velocity_pairs(const velocity_pairs *at)
{
  ddl part[GROUPS][M]; /* of which the first is used */
  for (int n = 0; n < GROUPS; n++) {
    ddl u[2 * M], value[INTEGRALS];
    memcpy(u, at->q[n], sizeof at->q[n]);
    memcpy(u + M, at->z[n], sizeof at->z[n]);
    integrand_lanes_pairs(u, ddl_of(at->t), at->parameters, value);
    part[n][0] = ddl_multiply(at->momentum_weight[n], value[0]);
  }
  return weighted_total(POINT_END_MOMENTUM, POINT_END_MOMENTUM_LOW, part, 0);
}
#endif

/* Replaces the increments of a step that the iteration solved in double by those in two words. On failure they are
 * undefined. */
static int refine_velocities(const step_data *step, double t_low, double h_low, double *dq, double *dp, double *passed)
{
  velocity_pairs at;
  lanes f[GROUPS][2 * M];
  ddl scaled[GROUPS][M];
  double size = INFINITY;
  begin_velocity_pairs(step, t_low, h_low, &at);
  for (int k = 0; !(size <= LINEAR_CORRECTION); k++) {
    if (k == MOST_EVALUATIONS)
      return NOT_CONVERGED;
    find_velocity_residual(&at);
    if (k == 0)
      find_velocity_derivatives(&at);
    size = find_velocity_correction(&at, f);
    TRY(is_finite(size) ? OK : NOT_CONVERGED);
    for (int n = 0; n < GROUPS; n++)
      for (int i = 0; i < M; i++)
        at.z[n][i] = ddl_add(at.z[n][i], ddl_word(at.vector[n][M + i]));
  }
  for (int n = 0; n < GROUPS; n++)
    for (int i = 0; i < M; i++) {
      at.q[n][i] = ddl_add(at.q[n][i], ddl_word(at.vector[n][i]));
      at.F[n][i] = ddl_add(at.F[n][i], ddl_word(f[n][i]));
    }
#ifdef TIME_TRANSFORMATION
  const dd duration = duration_of_velocity_pairs(&at);
  passed[0] = duration.high, passed[1] = duration.low;
#endif
  weigh_pairs(at.position_weight, at.z, scaled);
  for (int i = 0; i < M; i++) {
    const dd q = weighted_total(POINT_END_POSITION, POINT_END_POSITION_LOW, scaled, i);
    dq[i] = q.high, dq[M + i] = q.low;
  }
  weigh_pairs(at.momentum_weight, at.F, scaled);
  for (int i = 0; i < M; i++) {
    const dd p = weighted_total(POINT_END_MOMENTUM, POINT_END_MOMENTUM_LOW, scaled, i);
    dp[i] = p.high, dp[M + i] = p.low;
  }
  return all_finite(dq, 2 * M) && all_finite(dp, 2 * M) ? OK : NOT_FINITE;
}
