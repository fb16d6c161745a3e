/* Steps of RATTLE for constant diagonal masses, without the matrix of Newton's iteration: the multipliers that lead to
 * g(q1) = 0, then those that put p1 on the tangent space, by systems of one equation a constraint. Before it: newton.h,
 * constraints.h, the kernels held_force and held_mass; PRODUCTS, pairs {e, f} of slopes of which the product belongs to
 * the entry {k, l} of PRODUCT_ENTRY; HELD_PLACE of constraints, HELD_REACH of their matrix. */
#define RATTLE

static band held_shape(void)
{
  const int full = 3 * HELD_REACH + 1 >= CONSTRAINTS;
  const band shape = {CONSTRAINTS, HELD_REACH, full ? CONSTRAINTS : 3 * HELD_REACH, full ? 0 : 2 * HELD_REACH};
  return shape;
}

/* x += scale slope^T lambda. */
static inline void add_reactions(const real *slope, const real *lambda, real scale, real *x)
{
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++)
    x[CONSTRAINT_ENTRY[e][1]] += scale * slope[e] * lambda[CONSTRAINT_ENTRY[e][0]];
}

/* lambda of scale one M^-1 other^T lambda = -right; 0 if that matrix has no inverse. */
static int solve_held(const newton_data *data, const real *one, const real *other, const real *inverse_mass, real scale,
    const real *right, real *lambda)
{
  const band shape = held_shape();
  memset(data->factors, 0, sizeof(real) * band_size(&shape));
  for (int n = 0; n < PRODUCTS; n++) {
    const int e = PRODUCT[n][0], f = PRODUCT[n][1], column = HELD_PLACE[PRODUCT_ENTRY[n][1]];
    data->factors[shape.first + column * shape.stride + HELD_PLACE[PRODUCT_ENTRY[n][0]]] +=
        scale * one[e] * inverse_mass[CONSTRAINT_ENTRY[e][1]] * other[f];
  }
  if (!all_finite(right, CONSTRAINTS) || !all_finite(data->factors, (int)band_size(&shape)) ||
      !factorise(data->factors, &shape, data->pivot))
    return 0;
  for (int k = 0; k < CONSTRAINTS; k++)
    data->update[HELD_PLACE[k]] = -right[k];
  back_substitute(data->factors, &shape, data->pivot, data->update);
  for (int k = 0; k < CONSTRAINTS; k++)
    lambda[k] = data->update[HELD_PLACE[k]];
  return 1;
}

/* What the step begins with, and the half of it that positions follow. */
typedef struct {
  real inverse_mass[M], force[M], slope[CONSTRAINT_ENTRIES], lambda[CONSTRAINTS], v[M];
} half_step;

/* The velocity v that lambda gives, and where it leads. */
static void lead(const step_data *step, half_step *now, real *u)
{
  real impulse[M];
  memcpy(impulse, now->force, sizeof impulse);
  add_reactions(now->slope, now->lambda, 1, impulse);
  for (int i = 0; i < M; i++) {
    now->v[i] = (step->p0[i] + step->h / 2 * impulse[i]) * now->inverse_mass[i];
    u[i] = step->q0[i] + (step->carry_q[i] + step->h * now->v[i]);
  }
}

/* By how much a change of lambda moves positions. */
static movement moved_by(const step_data *step, const half_step *now, const real *change)
{
  movement moved = no_movement();
  real moves[M] = {0}, size[M];
  add_reactions(now->slope, change, step->h * step->h / 2, moves);
  for (int i = 0; i < M; i++) {
    moves[i] *= now->inverse_mass[i];
    size[i] = MATH(fabs)(step->q0[i]) + MATH(fabs)(step->h * now->v[i]);
  }
  measure(&moved, moves, size);
  return moved;
}

/* lambda and u with g(u) = 0, and the slopes there. */
static int meet(const step_data *step, half_step *now, const newton_data *data, real *u, real *slope,
    const solver_options *options, solver_report *report)
{
  real g[CONSTRAINTS], change[CONSTRAINTS], last = (real)INFINITY;
  for (int k = 0, met = 0;; k++) {
    movement moved;
    lead(step, now, u);
    constraints(u, step->t + step->h, step->parameters, g, slope);
    if (met)
      return all_finite(u, M) ? OK : NOT_FINITE;
    if (k >= least(options->max_iterations, MOST_ITERATIONS))
      return NOT_CONVERGED;
    if (!solve_held(data, slope, now->slope, now->inverse_mass, step->h * step->h / 2, g, change))
      return SINGULAR;
    for (int j = 0; j < CONSTRAINTS; j++)
      now->lambda[j] += change[j];
    moved = moved_by(step, now, change);
    report->iterations++;
    report->change = options->absolute ? moved.absolute : moved.relative;
    if (options->absolute)
      met = moved.absolute < options->tolerance;
    else
      met = moved.relative <= options->tolerance ||
          (moved.overall <= ROUNDOFF_LEVEL && moved.relative >= STOPPED_SHRINKING * last);
    last = moved.relative;
  }
}

/* Unknowns z of the step, and p1 - p0; memory has those of the step before, if guess. */
static int rattle(const step_data *step, const real *memory, int guess, const newton_data *data, real *dp,
    const solver_options *options, solver_report *report)
{
  half_step now;
  real u[2 * M], g[CONSTRAINTS], slope[CONSTRAINT_ENTRIES], force[M], lambda[CONSTRAINTS], value[M + 2 * CONSTRAINTS];
  int status;
  held_mass(NULL, step->t, step->parameters, now.inverse_mass);
  held_force(step->q0, step->t, step->parameters, now.force);
  constraints(step->q0, step->t, step->parameters, g, now.slope);
  for (int i = 0; i < M; i++)
    now.inverse_mass[i] = 1 / now.inverse_mass[i];
  for (int k = 0; k < CONSTRAINTS; k++)
    now.lambda[k] = guess ? memory[(M + k) * B + 1] : 0;
  status = meet(step, &now, data, u, slope, options, report);
  if (status != OK)
    return status;
  held_force(u, step->t + step->h, step->parameters, force);
  for (int i = 0; i < M; i++)
    dp[i] = step->h / 2 * (now.force[i] + force[i]);
  add_reactions(now.slope, now.lambda, step->h / 2, dp);
  for (int i = 0; i < M; i++)
    u[M + i] = (step->p0[i] + dp[i]) * now.inverse_mass[i];
  constrained_motion(u, step->t + step->h, step->parameters, value);
  if (!solve_held(data, slope, slope, now.inverse_mass, step->h / 2, value + M, lambda))
    return SINGULAR;
  add_reactions(slope, lambda, step->h / 2, dp);
  for (int i = 0; i < M; i++) {
    data->z[i * B] = now.v[i];
    data->z[i * B + 1] = (step->p0[i] + dp[i]) * now.inverse_mass[i];
  }
  for (int k = 0; k < CONSTRAINTS; k++) {
    data->z[(M + k) * B] = now.lambda[k];
    data->z[(M + k) * B + 1] = lambda[k];
  }
  return OK;
}
