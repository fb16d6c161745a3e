#include "events.h"

/* Changes of the state by one event: impacts and maps.
 *
 * Frictionless impacts change p by lambda n, n = g_q; lambda = (1 + e)/2 lambda_1, where lambda_1 conserves energy:
 * H(p + lambda_1 n) - H(p) = -lambda_1 g_t. With constraints (EVENT_CONSTRAINTS), of Jacobian G, n is g_q - G^T kappa,
 * G H_pp n = 0: momenta are projected. Requires: events.h, changes_by, IS_IMPACT. */
enum {
  CHANGE_ITERATIONS = 50, /* of Newton's method for an impulse */
  CHANGE_SAFETY = 64 /* roundings by which a state may be behind a wall */
};

/* Momenta that satisfy the constraints at a state, of which the impulses of an impact and of its constraint forces
 * together are a multiple of the projected normal: P(p + lambda n). Positions are projected, too, if `moves`. */
static int satisfy_constraints(const event_step *step, real t, real *q, real *p, int moves)
{
#ifdef EVENT_CONSTRAINTS
  real *const q1 = step->memory, *const p1 = q1 + M;
  TRY(NAME(project)(t, q, p, step->parameters, q1, p1, step->workspace));
  memcpy(p, p1, BYTES(M));
  if (moves)
    memcpy(q, q1, BYTES(M));
#endif
  return OK;
}

/* Momenta p + lambda n. */
static void add_impulse(const event_entries *wall, real lambda, const real *p, real *moved)
{
  memcpy(moved, p, BYTES(M));
  for (int i = 0; i < wall->count; i++)
    moved[wall->place[i]] += lambda * wall->value[i];
}

/* Velocities at p + lambda n, and n.v + g_t; wall NULL: at p. */
static int approach(const event_step *step, const event_sample *at, const event_entries *wall, real lambda, real *v,
    real *rate)
{
  const event_entries none = {.count = 0};
  real *const p = step->memory + 2 * M;
  wall = wall ? wall : &none;
  add_impulse(wall, lambda, at->p, p);
  TRY(satisfy_constraints(step, at->t, at->q, p, 0));
  TRY(NAME(velocity)(at->t, at->q, p, step->parameters, v, step->workspace));
  *rate = wall->by_time;
  for (int i = 0; i < wall->count; i++)
    *rate += wall->value[i] * v[wall->place[i]];
  return OK;
}

#ifdef EVENT_REFRACTS
#define IS_WALL(event) (IS_IMPACT[event] || REFRACTS[event]) /* momenta change along the gradient of its function */
#else
#define IS_WALL(event) IS_IMPACT[event]
#endif

/* Changes by function e; if it is a wall, with its rate at velocities v. */
static int evaluate_changes(const event_step *step, int e, const event_sample *at, const real *v, event_entries *wall)
{
  TRY(changes_by(e, at->t, at->q, at->p, step->parameters, step->values + EVENT_VALUES * EVENTS, wall,
      step->workspace));
  if (!IS_WALL(EVENT_OF(e)))
    return OK;
  wall->rate = wall->by_time;
  wall->size = fabs(wall->by_time);
  const NAME(event_history) *const history = step->watch->history + e;
  const real since = history->hits > 0 ? fabs(step->watch->time - history->last) : 0.0;
  wall->slack = fabs(wall->by_time * at->t);
  for (int i = 0; i < wall->count; i++) {
    const int k = wall->place[i];
    wall->rate += wall->value[i] * v[k];
    wall->size += fabs(wall->value[i] * v[k]);
    wall->slack += fabs(wall->value[i]) * (fabs(at->q[k]) + fabs(v[k]) * (fabs(step->whole) + since));
  }
  wall->slack *= CHANGE_SAFETY * DBL_EPSILON;
  wall->rate *= step->h < 0.0 ? -1.0 : 1.0;
  return OK;
}

/* Changes by function e at the velocities of a state. */
static int changes_at(const event_step *step, int e, const event_sample *at, event_entries *wall)
{
  real rate, *const v = step->memory + 3 * M;
  if (IS_WALL(EVENT_OF(e)))
    TRY(approach(step, at, NULL, 0.0, v, &rate));
  return evaluate_changes(step, e, at, v, wall);
}

/* sum + low += a b with the rounding errors of product and sum (Dekker; Ogita, Rump & Oishi, SIAM J. Sci. Comput. 26
 * (2005) 1955). */
static void add_product(real a, real b, real *sum, real *low)
{
  const real product = a * b, total = *sum + product, moved = total - *sum;
  *low += rest_of_product(a, b, product) + ((*sum - (total - moved)) + (product - moved));
  *sum = total;
}

/* Correction of lambda by Newton's method for the energy equation of a quadratic kinetic energy divided by lambda,
 * n.v + g_t + (lambda / 2) n.(W n) = 0, evaluated in twice the precision: the rounding error of lambda has a mean
 * that is not zero, from which energy would drift over many impacts. v, change: velocities before the impact, W n. */
static real correct_impulse(const event_entries *wall, const real *v, const real *change, real lambda, real rate)
{
  real sum = wall->by_time, low = 0.0, bend = 0.0, bend_low = 0.0;
  for (int i = 0; i < wall->count; i++) {
    add_product(wall->value[i], v[wall->place[i]], &sum, &low);
    add_product(wall->value[i], change[wall->place[i]], &bend, &bend_low);
  }
  add_product(0.5 * lambda, bend, &sum, &low);
  return lambda * (sum + (low + 0.5 * lambda * bend_low)) / rate;
}

/* Mean of n.v + g_t on the way from p to p + lambda n by Gauss quadrature with three nodes: the energy equation divided
 * by lambda, without the cancellation of H(p + lambda n) - H(p) of small impulses. */
static int mean_rate(const event_step *step, const event_sample *at, const event_entries *wall, real lambda, real *v,
    real *mean)
{
  static const real NODE[3] = {0.11270166537925831, 0.5, 0.88729833462074169};
  static const real WEIGHT[3] = {5.0 / 18, 4.0 / 9, 5.0 / 18};
  *mean = 0.0;
  for (int k = 0; k < 3; k++) {
    real rate = 0.0;
    TRY(approach(step, at, wall, NODE[k] * lambda, v, &rate));
    *mean += WEIGHT[k] * rate;
  }
  return OK;
}

/* H(p1) + lambda g_t - (p1 - u).v of p1 = P(u), u = p + lambda n, which an impulse conserves, of velocities v. The last
 * term is the work of the constraints, mu.c_t = -mu.(G v). */
static int energy_after(const event_step *step, const event_sample *at, const event_entries *wall, real lambda,
    const real *v, real *energy)
{
  real *const moved = step->memory + 4 * M, *const free = moved + M;
  add_impulse(wall, lambda, at->p, free);
  memcpy(moved, free, BYTES(M));
  TRY(satisfy_constraints(step, at->t, at->q, moved, 0));
  TRY(NAME(energy)(at->t, at->q, moved, step->parameters, energy, step->workspace));
  *energy += lambda * wall->by_time;
  for (int i = 0; i < M; i++)
    *energy -= (moved[i] - free[i]) * v[i];
  return OK;
}

/* Newton's method for the impulse lambda by which the energy becomes `after` from `start` at lambda = 0. Its derivative
 * is the rate, of the sign of `toward` along the way: H is convex along n. *passes: whether there is one. */
static int solve_impulse(const event_step *step, const event_sample *at, const event_entries *wall, real start,
    real after, real toward, real *lambda, int *passes)
{
  real *const v = step->memory + 3 * M;
  real rate, mean = 0.0, now = after, size = fabs(after), last = INFINITY;
  TRY(approach(step, at, wall, *lambda, v, &rate));
  *passes = 1;
  for (int k = 0; k < CHANGE_ITERATIONS; k++) {
    real correction, precise;
    if (!(toward * rate > 0.0)) {
      *passes = 0;
      return OK;
    }
    TRY(energy_after(step, at, wall, *lambda, v, &now));
    TRY(mean_rate(step, at, wall, *lambda, v, &mean));
    precise = start - after + *lambda * mean;
    correction = now - after;
    size = fabs(after) + fabs(now) + fabs(*lambda) * wall->size;
    if (fabs(correction - precise) <= 4.0 * DBL_EPSILON * size)
      correction = precise; /* the difference is rounding of the energy */
    correction /= rate;
    if (!(fabs(correction) < last))
      break; /* the correction is rounding */
    last = fabs(correction);
    *lambda -= correction;
    TRY(approach(step, at, wall, *lambda, v, &rate));
  }
  *passes = fabs(now - after) <= CHANGE_SAFETY * DBL_EPSILON * size;
  return OK;
}

/* Impulse of an impact: p += (1 + e)/2 lambda_1 n. Where the kinetic energy is quadratic, i.e. W n, W = H_pp, is the
 * same at p and at 0, lambda_1 = -2 rate / (n.W n) reverses the rate; else Newton's method solves the energy equation,
 * whose derivative by lambda is the rate. A run backward in time undoes the impact. */
static int impact(const event_step *step, event_sample *at, const event_entries *wall)
{
  const real restitution = step->h < 0.0 ? 1.0 / wall->restitution : wall->restitution;
  const real rate = step->h < 0.0 ? -wall->rate : wall->rate;
  event_sample moved = *at;
  real *const v = step->memory + 3 * M, *const rest = v + 2 * M, *const change = rest + M;
  real lambda, low = 0.0, at_rest = 0.0, after = 0.0, energy = 0.0, before = INFINITY;
  real inverse_mass, there = 0.0, size = wall->size;
  int solved;
  moved.p = step->memory + 4 * M;
  memset(moved.p, 0, BYTES(M));
  TRY(approach(step, &moved, wall, 0.0, rest, &at_rest));
  TRY(approach(step, &moved, wall, 1.0, change, &after));
  inverse_mass = after - at_rest;
  TRY(approach(step, at, wall, 1.0, v, &there));
  for (int i = 0; i < wall->count; i++)
    size += fabs(wall->value[i] * v[wall->place[i]]) + fabs(wall->value[i] * change[wall->place[i]]);
  lambda = -2.0 * rate / inverse_mass;
  if (!(fabs(there - rate - inverse_mass) <= CHANGE_SAFETY * DBL_EPSILON * size)) {
    TRY(NAME(energy)(at->t, at->q, at->p, step->parameters, &energy, step->workspace));
    TRY(approach(step, at, wall, lambda, v, &after));
  } else {
    before = 0.0; /* the kinetic energy is quadratic */
    TRY(approach(step, at, wall, 0.0, v, &after));
    for (int i = 0; i < M; i++)
      change[i] -= rest[i];
    low = correct_impulse(wall, v, change, lambda, rate);
  }
  for (int k = 0; before > 0.0 && k < CHANGE_ITERATIONS && !(after * rate < 0.0); k++) {
    lambda *= 2.0; /* beyond the minimum of the convex energy: Newton's method does not return to lambda = 0 */
    TRY(approach(step, at, wall, lambda, v, &after));
  }
  if (before > 0.0)
    TRY(solve_impulse(step, at, wall, energy, energy, -rate, &lambda, &solved));
  lambda *= 0.5 * (1.0 + restitution);
  low *= 0.5 * (1.0 + restitution);
  for (int i = 0; i < wall->count; i++) {
    real *const p = at->p + wall->place[i], remainder = low * wall->value[i];
    add_product(lambda, wall->value[i], p, &remainder);
    *p += remainder;
  }
  return satisfy_constraints(step, at->t, at->q, at->p, 0);
}

/* Sets the variables of a map to its values, modes too; velocities are set last, by their momenta. */
static int apply_map(const event_step *step, event_sample *at, const event_entries *map)
{
  real *const v = step->memory + 3 * M;
  int by_velocity = 0;
  for (int i = 0; i < map->count; i++)
    by_velocity |= map->place[i] >= 2 * M && map->place[i] < 3 * M;
  if (by_velocity)
    TRY(NAME(velocity)(at->t, at->q, at->p, step->parameters, v, step->workspace));
  for (int i = 0; i < map->count; i++)
    if (map->place[i] < M)
      at->q[map->place[i]] = map->value[i];
    else if (map->place[i] < 2 * M)
      at->p[map->place[i] - M] = map->value[i];
#ifdef EVENT_MODES
    else if (map->place[i] >= 3 * M)
      step->watch->mode[map->place[i] - 3 * M] = map->value[i];
#endif
    else
      v[map->place[i] - 2 * M] = map->value[i];
#ifdef EVENT_MODES
  put_modes(step->watch->mode, step->own);
#endif
  return by_velocity ? NAME(momentum)(at->t, at->q, v, step->parameters, at->p, step->workspace) : OK;
}

/* Changes the state by function e: by its map, or by an impact if the wall is approached. */
static int change_state(const event_step *step, int e, event_sample *at)
{
  event_entries wall;
  int is_defined = 1;
  TRY(changes_at(step, e, at, &wall));
  if (IS_IMPACT[EVENT_OF(e)] && wall.rate < 0.0) {
    is_defined = wall.restitution >= 0.0;
    step->watch->history[e].slack = wall.slack;
    step->watch->history[e].rounding = wall.slack / -wall.rate;
    const int status = is_defined ? impact(step, at, &wall) : OK;
    if (status == NOT_CONVERGED)
      step->watch->jammed = EVENT_OF(e) + 1; /* such as of prescribed motion, whose momenta no impulse changes */
    TRY(status);
  } else if (!IS_IMPACT[EVENT_OF(e)]) {
    if (evaluate_function(step, e, at) == OK)
      step->watch->history[e].slack = fabs(at->g);
    TRY(apply_map(step, at, &wall));
    TRY(satisfy_constraints(step, at->t, at->q, at->p, 1));
  }
#ifdef EVENT_MODES
  is_defined &= all_finite(step->watch->mode, EVENT_MODES);
#endif
  if (!is_defined || !all_finite(at->q, M) || !all_finite(at->p, M)) {
    step->watch->undefined = -(EVENT_OF(e) + 1);
    return NOT_FINITE;
  }
  return OK;
}
