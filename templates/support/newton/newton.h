#include "../core/status_codes.h"
#include "../core/step.h"
#include "band.h"

/* Newton's method for the stage equations, with reuse of the Jacobian's factors (simplified Newton; Hairer & Wanner,
 * Solving ODEs II, sec. IV.8). Requires: stages.h, the tables END_POSITION, MOMENTUM_ROW, STRAIGHT, MOMENTA and MOVES,
 * and evaluate, which computes the equations and their Jacobian; if DAMPED, damping.h. */

#define STOPPED_SHRINKING REAL(0.25) /* Newton updates converge quadratically: one that decreases by less is rounding */
#define STAGE_ROUNDOFF (REAL(32.0) * REAL_EPSILON) /* rounding error of positions that a stiff force determines */
#define STAGNATIONS (SITES > M ? 2 : 1) /* with frozen factors positions and multipliers converge one after the other */
#define REUSE_CHANGE REAL(1e-2) /* factors are reused while updates are below this part of the state */
#define REUSE_RATE REAL(0.1) /* and decrease at least tenfold: then another iteration costs less than new factors */
#define NEARBY_RATE REAL(0.5) /* of the first updates towards a root nearby: the second one by the first one */
#define NEARBY_CHANGE REAL(0.25) /* of this rate from one update to the next, */
#define FASTEST_RATE REAL(0.03) /* except of faster ones, at which updates may end in rounding */

/* Change of the stages and the end momentum by the last update: the largest ratio to the own size, the ratio of the
 * largest to the largest size, and the largest itself. */
typedef struct {
  real relative, overall, absolute, stages; /* stages: overall, of the positions of the stages alone */
  real action; /* with fresh factors: sum of the changes of these positions times the sizes of the momenta */
} movement;

static void measure(movement *moved, const real *change, const real *size)
{
  real largest_change = 0, largest_size = 0;
  for (int i = 0; i < M; i++) {
    const real ratio = change[i] != 0 ? MATH(fabs)(change[i]) / size[i] : 0;
    moved->relative = larger(moved->relative, ratio);
    largest_change = larger(largest_change, MATH(fabs)(change[i]));
    largest_size = larger(largest_size, size[i]);
  }
  if (largest_change > moved->overall * largest_size)
    moved->overall = largest_change / largest_size;
  moved->absolute = larger(moved->absolute, largest_change);
}

/* Workspace of Newton's method. */
typedef struct {
  real z[N]; /* unknowns */
  real rows[N + SITES], update[N + SITES]; /* residuals of the equations, and the solution of the linear system */
  real factors[JACOBIAN], pivot[N + SITES]; /* of the Jacobian */
  real point[]; /* t, q0 with its compensation and z where the factors were computed, if they are reused (POINT > 0) */
} newton_data;

static newton_data *newton_in(real *workspace)
{
  return (newton_data *)workspace;
}

/* Stages of a straight line with velocity v and momentum p0; other unknowns are 0. */
static void start_on_line(const real *v, const real *p0, real *z)
{
  memset(z + M * B, 0, sizeof(real) * (N - M * B));
  for (int i = 0; i < M; i++)
    for (int b = 0; b < B; b++)
      z[i * B + b] = STRAIGHT[b] * v[i] + MOMENTA[b] * p0[i];
}

/* z -= update, the solution with the current factors, fresh ones or those of another iterate; p0 likewise, if it is not
 * NULL. Measures the update. */
static inline void apply_update(newton_data *data, const band *shape, real h, real *p0, const real *size_p,
    const real *size_q, int is_fresh, movement *moved)
{
  const int blocks = shape->rows / SITES;
  real change[SITES];
  for (int i = 0; i < SITES; i++)
    memcpy(data->update + POSITION_IN_MATRIX[i] * blocks, data->rows + i * (B + 1), sizeof(real) * (size_t)blocks);
  back_substitute(data->factors, shape, data->pivot, data->update);
  for (int i = 0; i < SITES; i++) {
    const real *update = data->update + POSITION_IN_MATRIX[i] * blocks;
    change[i] = 0;
    for (int b = 0; b < B; b++) {
      data->z[i * B + b] -= update[b];
      change[i] = larger(change[i], MATH(fabs)(h * MOVES[b] * update[b]));
    }
  }
  measure(moved, change, size_q);
  moved->stages = moved->overall;
  for (int i = 0; is_fresh && i < M; i++)
    moved->action += change[i] * size_p[i];
  for (int i = 0; p0 && i < M; i++) {
    change[i] = data->update[POSITION_IN_MATRIX[i] * blocks + B];
    p0[i] -= change[i];
  }
  if (p0)
    measure(moved, change, size_p);
}

/* Returns 1 if an update at round-off level no longer decreases. A stiff force amplifies the rounding of positions in
 * the momenta: then only the positions are at round-off, and the momenta cannot be computed more accurately. */
static int has_stagnated(const movement *moved, real last)
{
  return moved->relative >= STOPPED_SHRINKING * last &&
      (moved->overall <= ROUNDOFF_LEVEL || moved->stages <= STAGE_ROUNDOFF);
}

/* Returns 1 if the iterate that `moved` led to is accepted: its update is below the tolerance, or has stalled at
 * round-off level. With frozen factors convergence is linear: one decrease is required, and two to distinguish
 * round-off from slow convergence. */
static int has_converged(const solver_options *options, const movement *moved, int stagnations, int trials)
{
  if (trials < 2)
    return 0;
  if (options->absolute)
    return moved->absolute < options->tolerance;
  if (moved->relative <= options->tolerance)
    return 1;
  return trials > 2 && stagnations >= STAGNATIONS;
}

/* Returns 1 if an update, after one of the action `before`, may lead to a root nearby; `first`, that of the first one,
 * shows which are rounding, of any rate. By the theorem of Newton and Kantorovich one root is near an iterate, and
 * continues that of equations little different, if h_0 <= 1/2 for h_k = omega |update k|, omega a Lipschitz constant of
 * the Jacobian relative to itself. The rate of successive updates is at most h_k / 2 and estimates h_k; so does its
 * change, since h_k+1 = h_k^2 / 2 (Deuflhard, Newton Methods for Nonlinear Problems, sec. 2.1). */
static inline int is_nearby(const movement *moved, real first, real before, real *rate)
{
  const real most = *rate == 0 ? NEARBY_RATE : larger(NEARBY_CHANGE * *rate, FASTEST_RATE);
  *rate = moved->action / before;
  return !(*rate > most) || moved->overall < MATH(sqrt)(REAL_EPSILON) || before <= REAL_EPSILON * first;
}

/* Displacement times impulse by the reactions among unknowns z: updates of this action times the rounding are rounding,
 * also where all are, from rest at the origin. 0 without constraints. */
static SELDOM real action_of_reactions(const step_data *step, const real *z)
{
#ifdef CONSTRAINED
  real impulse;
  const real displacement = displacement_by_reactions(step, z, &impulse);
  return displacement * impulse;
#else
  return (void)step, (void)z, (real)0;
#endif
}

/* Replaces the row of p1 - p0 by q0 + h sum_b beta_b z_b = q1, with p0 as a further unknown. */
static void add_boundary(const step_data *step, newton_data *data, const real *q1, int with_jacobian, const band *shape)
{
  for (int i = 0; i < M; i++) {
    real *row = data->rows + i * (B + 1) + B;
    *row = -(q1[i] - step->q0[i]) / step->h;
    for (int b = 0; b < B; b++)
      *row += END_POSITION[b] * data->z[i * B + b];
  }
  for (int i = 0; with_jacobian && i < M; i++) {
    real *corner = data->factors + shape->first + POSITION_IN_MATRIX[i] * (B + 1) * (shape->stride + 1);
    for (int b = 0; b < B; b++) {
      corner[B * shape->stride + b] = MOMENTUM_ROW[b];
      corner[b * shape->stride + B] = END_POSITION[b];
    }
  }
}

/* Evaluates the equations, the sizes of their terms and the increment p1 - p0, which changes by `change`. */
static int evaluate_increment(const step_data *step, newton_data *data, const real *q1, int with_jacobian,
    const band *shape, real *size_p, real *size_q, real *increment, real *change)
{
  evaluate(step, data->z, data->rows, size_p, size_q, with_jacobian ? data->factors : NULL, shape);
  for (int i = 0; i < M; i++) {
    change[i] = data->rows[i * (B + 1) + B] - increment[i];
    increment[i] = data->rows[i * (B + 1) + B];
  }
  if (q1)
    add_boundary(step, data, q1, with_jacobian, shape);
  return all_finite(data->rows, N + SITES) && all_finite(increment, M) && all_finite(size_p, M) && all_finite(size_q, M)
      ? OK
      : NOT_FINITE;
}

/* Factorises the Jacobian and stores where it was evaluated. Returns 0 if it is singular. */
static int linearise(const step_data *step, newton_data *data, const band *shape)
{
  if (POINT > 0) {
    data->point[0] = step->t;
    memcpy(data->point + 1, step->q0, sizeof(real) * M);
    memcpy(data->point + 1 + M, step->carry_q, sizeof(real) * M);
    memcpy(data->point + 1 + 2 * M, data->z, sizeof(real) * N);
  }
  return factorise(data->factors, shape, data->pivot);
}

/* Adds displacements whose rounding errors are those of what they depend on, above that of the positions: of g, of
 * reactions among the unknowns z, and of the velocities v(q, y) of a first-order system, |h| |dv/du| |u| for
 * u = (q, y). There updates stagnate. */
static SELDOM void add_sizes_of_arguments(const step_data *step, const real *z, real *size)
{
#ifdef CONSTRAINED
  real impulse;
  const real by_reactions = displacement_by_reactions(step, z, &impulse);
  add_constraint_sizes(ACTUAL_FORCES, step->t, step->q0, step->parameters, saddle_in(step->scratch), size);
  for (int i = 0; i < M; i++)
    size[i] += by_reactions;
#elif defined(FIRST_ORDER_SYSTEM) && !defined(DOUBLE_DOUBLE) /* whose error estimates resolve these */
  const real part = MATH(sqrt)(REAL_EPSILON);
  real u[2 * M], v[M], moved[M];
  memcpy(u, step->q0, sizeof(real) * M);
  memcpy(u + M, step->p0, sizeof(real) * M);
  if (find_velocity(step->t, u, u + M, step->parameters, v, step->scratch) != OK)
    return;
  for (int k = 0; k < 2 * M; k++) {
    const real before = u[k];
    u[k] += part * before;
    if (find_velocity(step->t, u, u + M, step->parameters, moved, step->scratch) == OK)
      for (int i = 0; i < M; i++)
        size[i] += MATH(fabs)(step->h * (moved[i] - v[i])) / part;
    u[k] = before;
  }
#endif
}

/* Solves the stage equations from the initial guess in z; on success z and the increment p1 - p0 are consistent, on
 * failure they are undefined; SPURIOUS_SOLUTION if the root may not be near the guess. The factors, of an earlier step
 * if *keep, are reused as long as updates are small and decrease fast. With an end position q1, p0 is unknown, too, and
 * solved for in place. */
static int newton(const step_data *step, newton_data *data, const real *q1, real *p0, real *increment, int *keep,
    const solver_options *options, solver_report *report)
{
  const band shape = band_of(SITES, q1 ? B + 1 : B);
  real size_q[M], size_p[SITES], change[M], added[M] = {0}, last = (real)INFINITY, rate = 0, first = 0;
  movement moved = {0};
  int trials = 0, stagnations = 0, slow = 0;
  memset(increment, 0, sizeof(real) * M);
  for (int k = 0;; k++) {
    TRY(evaluate_increment(step, data, q1, !*keep, &shape, size_p, size_q, increment, change));
    for (int i = 0; i < M; i++)
      size_q[i] += added[i];
    if (k > 0) {
      measure(&moved, change, size_p);
      report->change = options->absolute ? moved.absolute : moved.relative;
      stagnations += has_stagnated(&moved, last);
      if (has_converged(options, &moved, stagnations, trials)) {
#ifdef DAMPED
        shrink(step, increment);
#endif
        return OK;
      }
      slow += moved.relative >= STOPPED_SHRINKING * last;
      if (slow == STAGNATIONS)
        add_sizes_of_arguments(step, data->z, added);
      last = moved.relative;
    }
    if (k >= least(options->max_iterations, MOST_ITERATIONS))
      return NOT_CONVERGED;
    trials = *keep ? trials + 1 : 3;
    TRY(*keep || linearise(step, data, &shape) ? OK : SINGULAR);
    const real before = moved.action;
    moved = (movement){0};
    apply_update(data, &shape, step->h, p0, size_p, size_q, !*keep, &moved);
    first = k == 0 ? moved.action : first;
    if (!q1 && !*keep && before > 0 && !is_nearby(&moved, first, before, &rate) &&
        !(before <= REAL_EPSILON * action_of_reactions(step, data->z)))
      return STATUS(SPURIOUS_SOLUTION);
    *keep = has_converged(options, &moved, stagnations + has_stagnated(&moved, last), trials) ||
        (moved.overall < REUSE_CHANGE && moved.relative < REUSE_RATE * last);
    report->iterations++;
  }
}
