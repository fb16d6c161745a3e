#include "../newton/newton.h"

/* Constrained steps on Lobatto points for constant diagonal masses (RATTLE for two points; Lobatto IIIA-IIIB: L.
 * Jay, SIAM J. Numer. Anal. 33, 1996), without the full Newton matrix: simplified Newton iteration for the
 * multipliers that give g = 0 at the points, with the factors at their initial guess, in which the forces are
 * updated; then the multipliers that project p1 onto the tangent space. Requires: newton.h, constraints.h, the
 * kernels constrained_force and constrained_mass; the tables RATTLE_ABSCISSA, RATTLE_WEIGHT, RATTLE_START,
 * RATTLE_MOMENTUM and its low words, RATTLE_POSITION and RATTLE_RESPONSE; PRODUCTS, pairs {e, f} of derivatives
 * whose product belongs to the entry {k, l} of PRODUCT_ENTRY; CONSTRAINT_POSITION of constraints, CONSTRAINT_REACH
 * of their matrix. */
#define RATTLE

enum { DEGREE = B - 1 }; /* of B points; values at point n are n elements after those at the first */

/* Positions u at all points but the first; forces L_q and derivatives G at all; multipliers at all but the last. */
typedef struct {
  real inverse_mass[M], u[M * DEGREE], force[M * B], derivative[CONSTRAINT_ENTRIES * B], lambda[CONSTRAINTS * DEGREE];
} rattle_step;

static band multiplier_shape(int count)
{
  return band_within(CONSTRAINTS * count, (CONSTRAINT_REACH + 1) * count - 1);
}

/* Factorises scale sum over coordinates of row_r response[n][r] column_n / mass, with rows r of each constraint, and
 * columns n; row and column are derivatives at `count` points. Returns 0 if that matrix is singular. */
static int factorise_multipliers(newton_data *data, const real *row, const real *column, const real *response,
    int count,
    const real *inverse_mass, real scale)
{
  const band shape = multiplier_shape(count);
  memset(data->factors, 0, sizeof(real) * band_size(&shape));
  for (int q = 0; q < PRODUCTS; q++) {
    const int e = PRODUCT[q][0], f = PRODUCT[q][1], to = CONSTRAINT_POSITION[PRODUCT_ENTRY[q][1]] * count;
    real *corner = data->factors + shape.first + to * shape.stride + CONSTRAINT_POSITION[PRODUCT_ENTRY[q][0]] * count;
    for (int n = 0; n < count; n++) {
      const real term = scale * inverse_mass[CONSTRAINT_ENTRY[e][1]] * column[f * B + n];
      for (int r = 0; r < count; r++)
        corner[n * shape.stride + r] += response[n * count + r] * row[e * B + r] * term;
    }
  }
  return all_finite(data->factors, (int)band_size(&shape)) && factorise(data->factors, &shape, data->pivot);
}

/* Solves matrix x = -right with these factors. */
static void solve_multipliers(newton_data *data, const real *right, int count, real *x)
{
  const band shape = multiplier_shape(count);
  for (int k = 0; k < CONSTRAINTS; k++)
    for (int r = 0; r < count; r++)
      data->update[CONSTRAINT_POSITION[k] * count + r] = -right[k * count + r];
  back_substitute(data->factors, &shape, data->pivot, data->update);
  for (int k = 0; k < CONSTRAINTS; k++)
    memcpy(x + k * count, data->update + CONSTRAINT_POSITION[k] * count, sizeof(real) * (size_t)count);
}

/* Evaluates the force and the constraint derivatives at point n, at position u, and the constraints g. */
static void evaluate_point(const step_data *step, int n, const real *u, rattle_step *now, real *g)
{
  real force[M], derivative[CONSTRAINT_ENTRIES];
  const real t = step->t + RATTLE_ABSCISSA[n] * step->h;
  constrained_force(u, t, step->parameters, force);
  constraints(u, t, step->parameters, g, derivative);
  for (int i = 0; i < M; i++)
    now->force[i * B + n] = force[i];
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++)
    now->derivative[e * B + n] = derivative[e];
}

/* Evaluates all points but the first. */
static void evaluate_points(const step_data *step, rattle_step *now, real *g)
{
  for (int n = 0; n < DEGREE; n++) {
    real u[M], own[CONSTRAINTS];
    for (int i = 0; i < M; i++)
      u[i] = now->u[i * DEGREE + n];
    evaluate_point(step, n + 1, u, now, own);
    for (int k = 0; k < CONSTRAINTS; k++)
      g[k * DEGREE + n] = own[k];
  }
}

/* f += G^T lambda at all points but the last. */
static void add_constraint_forces(const rattle_step *now, const real *lambda, real *f)
{
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++) {
    const real *derivative = now->derivative + e * B, *own = lambda + CONSTRAINT_ENTRY[e][0] * DEGREE;
    real *at = f + CONSTRAINT_ENTRY[e][1] * DEGREE;
    for (int n = 0; n < DEGREE; n++)
      at[n] += derivative[n] * own[n];
  }
}

/* f = L_q + G^T lambda at all points but the last. */
static void all_forces(const rattle_step *now, real *f)
{
  for (int i = 0; i < M; i++)
    for (int n = 0; n < DEGREE; n++)
      f[i * DEGREE + n] = now->force[i * B + n];
  add_constraint_forces(now, now->lambda, f);
}

/* Adds the displacements due to a change f of the forces: x += h^2 sum_n response[n] f_n / mass. */
static void add_response(const step_data *step, const rattle_step *now, const real *f, real *x)
{
  for (int i = 0; i < M; i++) {
    const real scale = step->h * step->h * now->inverse_mass[i];
    real sum[DEGREE] = {0};
    for (int n = 0; n < DEGREE; n++)
      for (int r = 0; r < DEGREE; r++)
        sum[r] += RATTLE_RESPONSE[n][r] * f[i * DEGREE + n];
    for (int r = 0; r < DEGREE; r++)
      x[i * DEGREE + r] += scale * sum[r];
  }
}

/* Velocities z due to the forces f. */
static void velocities_by(const step_data *step, const rattle_step *now, const real *f, real *z)
{
  for (int i = 0; i < M; i++) {
    real sum[DEGREE] = {0}, low[DEGREE] = {0};
    for (int n = 0; n < DEGREE; n++)
      for (int b = 0; b < DEGREE; b++) {
        sum[b] += RATTLE_MOMENTUM[n][b] * f[i * DEGREE + n];
        low[b] += RATTLE_MOMENTUM_LOW[n][b] * f[i * DEGREE + n];
      }
    for (int b = 0; b < DEGREE; b++)
      z[i * B + b] =
          (step->p0[i] + (RATTLE_START[b] * step->p0[i] + step->h * (sum[b] + low[b]))) * now->inverse_mass[i];
  }
}

/* Positions u due to the velocities z. */
static void positions_by(const step_data *step, const real *z, real *u)
{
  for (int i = 0; i < M; i++) {
    real sum[DEGREE] = {0};
    for (int b = 0; b < DEGREE; b++)
      for (int r = 0; r < DEGREE; r++)
        sum[r] += RATTLE_POSITION[b][r] * z[i * B + b];
    for (int r = 0; r < DEGREE; r++)
      u[i * DEGREE + r] = step->q0[i] + (step->carry_q[i] + step->h * sum[r]);
  }
}

/* Sizes of the terms of the displacements: forces and reactions cancel at a pinned coordinate, which may be 0. */
static void term_sizes(const step_data *step, const rattle_step *now, real *size)
{
  for (int i = 0; i < M; i++)
    size[i] = MATH(fabs)(now->force[i * B]);
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++)
    size[CONSTRAINT_ENTRY[e][1]] +=
        MATH(fabs)(now->derivative[e * B] * now->lambda[CONSTRAINT_ENTRY[e][0] * DEGREE]);
  for (int i = 0; i < M; i++)
    size[i] = MATH(fabs)(step->q0[i]) +
        MATH(fabs)(step->h * now->inverse_mass[i]) * (MATH(fabs)(step->p0[i]) + MATH(fabs)(step->h) * size[i]);
}

/* u += change; returns its size. */
static movement move(const step_data *step, rattle_step *now, const real *change)
{
  movement moved = no_movement();
  real most[M], size[M];
  term_sizes(step, now, size);
  for (int i = 0; i < M; i++) {
    most[i] = 0;
    for (int r = 0; r < DEGREE; r++) {
      now->u[i * DEGREE + r] += change[i * DEGREE + r];
      most[i] = larger(most[i], MATH(fabs)(change[i * DEGREE + r]));
    }
  }
  measure(&moved, most, size);
  return moved;
}

/* Solves g(u) = 0 for lambda and u; evaluates forces and constraints there. Returns SINGULAR, NOT_CONVERGED or
 * NOT_FINITE on failure. */
static int solve_constraints(const step_data *step, rattle_step *now, newton_data *data,
    const solver_options *options,
    solver_report *report)
{
  real g[CONSTRAINTS * DEGREE], lambda[CONSTRAINTS * DEGREE], f[M * DEGREE], change[M * DEGREE], last = (real)INFINITY;
  evaluate_points(step, now, g);
  if (!factorise_multipliers(data, now->derivative + 1, now->derivative, RATTLE_RESPONSE[0], DEGREE, now->inverse_mass,
          step->h * step->h))
    return SINGULAR;
  for (int k = 0; k < least(options->max_iterations, MOST_ITERATIONS); k++) {
    movement moved;
    int met;
    all_forces(now, f);
    velocities_by(step, now, f, data->z);
    positions_by(step, data->z, change);
    for (int j = 0; j < M * DEGREE; j++)
      change[j] -= now->u[j];
    for (int e = 0; e < CONSTRAINT_ENTRIES; e++) {
      const int row = CONSTRAINT_ENTRY[e][0] * DEGREE, column = CONSTRAINT_ENTRY[e][1] * DEGREE;
      for (int r = 0; r < DEGREE; r++)
        g[row + r] += now->derivative[e * B + r + 1] * change[column + r];
    }
    if (!all_finite(g, CONSTRAINTS * DEGREE))
      return NOT_FINITE;
    solve_multipliers(data, g, DEGREE, lambda);
    for (int j = 0; j < CONSTRAINTS * DEGREE; j++)
      now->lambda[j] += lambda[j];
    memset(f, 0, sizeof f);
    add_constraint_forces(now, lambda, f);
    add_response(step, now, f, change);
    moved = move(step, now, change);
    report->iterations++;
    report->change = options->absolute ? moved.absolute : moved.relative;
    evaluate_points(step, now, g);
    met = options->absolute ? moved.absolute < options->tolerance : moved.relative <= options->tolerance;
    if (met || (!options->absolute && moved.overall <= ROUNDOFF_LEVEL && moved.relative >= STOPPED_SHRINKING * last))
      return all_finite(now->u, M * DEGREE) ? OK : NOT_FINITE;
    if (k > 1 && moved.overall > ROUNDOFF_LEVEL && !(moved.relative < STOPPED_SHRINKING * last))
      return NOT_CONVERGED; /* Newton's method is faster */
    last = moved.relative;
  }
  return NOT_CONVERGED;
}

/* Initial values: the first point, and a guess of the others, from the unknowns in data->z. */
static void begin(const step_data *step, newton_data *data, rattle_step *now)
{
  real g[CONSTRAINTS];
  constrained_mass(NULL, step->t, step->parameters, now->inverse_mass);
  for (int i = 0; i < M; i++)
    now->inverse_mass[i] = 1 / now->inverse_mass[i];
  evaluate_point(step, 0, step->q0, now, g);
  positions_by(step, data->z, now->u);
  for (int k = 0; k < CONSTRAINTS; k++)
    memcpy(now->lambda + k * DEGREE, data->z + (M + k) * B, sizeof(real) * DEGREE);
}

/* Computes p1 - p0 on the tangent space, and the unknowns z of the step. */
static int finish_step(const step_data *step, const rattle_step *now, newton_data *data, real *dp)
{
  const real weight = step->h * RATTLE_WEIGHT[DEGREE];
  real f[M * DEGREE], u[2 * M], value[M + 2 * CONSTRAINTS], lambda[CONSTRAINTS], own[1] = {1};
  all_forces(now, f);
  for (int i = 0; i < M; i++) {
    real sum = RATTLE_WEIGHT[DEGREE] * now->force[i * B + DEGREE];
    for (int n = 0; n < DEGREE; n++)
      sum += RATTLE_WEIGHT[n] * f[i * DEGREE + n];
    dp[i] = step->h * sum;
    u[i] = now->u[i * DEGREE + DEGREE - 1];
    u[M + i] = (step->p0[i] + dp[i]) * now->inverse_mass[i];
  }
  constrained_motion(u, step->t + step->h, step->parameters, value);
  if (!all_finite(value, M + 2 * CONSTRAINTS) ||
      !factorise_multipliers(data, now->derivative + DEGREE, now->derivative + DEGREE, own, 1, now->inverse_mass,
          weight))
    return SINGULAR;
  solve_multipliers(data, value + M, 1, lambda);
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++)
    dp[CONSTRAINT_ENTRY[e][1]] += weight * now->derivative[e * B + DEGREE] * lambda[CONSTRAINT_ENTRY[e][0]];
  velocities_by(step, now, f, data->z);
  for (int i = 0; i < M; i++)
    data->z[i * B + DEGREE] = (step->p0[i] + dp[i]) * now->inverse_mass[i];
  for (int k = 0; k < CONSTRAINTS; k++) {
    memcpy(data->z + (M + k) * B, now->lambda + k * DEGREE, sizeof(real) * DEGREE);
    data->z[(M + k) * B + DEGREE] = lambda[k];
  }
  return OK;
}

/* Computes the unknowns z of the step, from their initial guess, and p1 - p0. On failure they are undefined. */
static int rattle(const step_data *step, newton_data *data, real *dp, const solver_options *options,
    solver_report *report)
{
  rattle_step now;
  int status;
  begin(step, data, &now);
  status = solve_constraints(step, &now, data, options, report);
  return status == OK ? finish_step(step, &now, data, dp) : status;
}
