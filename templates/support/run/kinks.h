#include "events.h"

/* Kinks: zeros of u in unit_step(u + mode). A step has one mode, so that its equations are smooth beyond u = 0, too; at
 * the zero of u the side changes and a new part of the step begins. Requires: EVENT_KINKS, FIRST_KINK, FIRST_SIDE,
 * MODE_PLACE, events.h. */
static int is_kink(int event)
{
#ifdef EVENT_KINKS
  return event >= FIRST_KINK;
#else
  return 0;
#endif
}

#ifdef EVENT_KINKS
#define KINK_SIDE 0x1p1000 /* beyond all values of u: the sign of u + mode is that of the mode */

#ifdef EVENT_CONSTRAINTS
#define KINK_FIRST_PROBE 10 /* shorter steps are ill-conditioned */
#else
#define KINK_FIRST_PROBE 40 /* 2^-40 of a step after its start u may have left zero */
#endif

enum {
  KINK_LAST_PROBE = 5,
  KINK_SEARCHES = 64 /* steps after which a far kink is searched for, too */
};

#define KINK_MISSED 16.0 /* effects of rounding beyond which the sign of the other side shows a missed crossing */
#define KINK_ZERO 0x1p-30 /* part of the change in a small part of a step below which u counts as 0 */
#define KINK_FAR 2.0 /* a kink is far beyond so many times the change of its function in a step */
#define KINK_FORGETS 0.97 /* factor of former rates of change for each step */
#define GRADE 0.5 /* step size relative to the time from or to the zero of the base of a power */
#define GRADE_FIRST 0.02 /* size of the first one relative to a trial by the error of a smooth motion */
#define GRADE_POWER 0.3 /* least such time by the tolerance: errors are of order 7/2 at the zero of u in u^(5/2) */

/* Sets the side of a kink in the search and in the parameters of its steps. */
static void set_side(const event_step *step, int kink, int side)
{
#ifdef EVENT_POWERS
  step->watch->depth[kink] = 0.0;
#endif
  SIDE_OF(step->watch, kink) = step->own[MODE_PLACE[FIRST_SIDE + kink]] = side * KINK_SIDE;
}

#ifdef EVENTS_OF_TIME /* whether the zeros of a kink do not depend on the state */
#define IS_OF_TIME(kink) (IS_TIMED[FIRST_KINK + (kink)] != 0)
#else
#define IS_OF_TIME(kink) 0
#endif

/* Values of all functions at a state; those of time alone eight roundings later, as at the ends of steps. */
static int values_of_kinks(const event_step *step, const event_sample *at, real *value)
{
  TRY(evaluate_functions(step, at, value));
#ifdef EVENTS_OF_TIME
  for (int k = 0; k < EVENT_KINKS; k++)
    if (IS_OF_TIME(k)) {
      const int e = EVENT_FIRST[FIRST_KINK + k];
      TRY(end_value(step, e, at->t, step->h, value + e));
    }
#endif
  return OK;
}

/* Effect of rounding on the function of a kink. */
static real rounding_at(const event_step *step, int kink)
{
  const int e = EVENT_FIRST[FIRST_KINK + kink];
  return 8.0 * values_at(step, EVENT_DEGREE + 2)[e] + RESIDUAL(step->watch, e);
}

/* The side of u at a state, 0 within the effect of rounding; values: of all functions there. */
static int side_of(const event_step *step, int kink, const real *value)
{
  const real g = value[EVENT_FIRST[FIRST_KINK + kink]], rounding = rounding_at(step, kink);
  return (g > rounding) - (g < -rounding);
}

/* Sides of all kinks at a state where a run is or starts: by the signs of their functions, within rounding as before.
 * Those that remain 0 follow from the first step. Returns their number in *unknown. */
static int settle_sides(const event_step *step, const event_sample *at, int *unknown)
{
  real *const value = values_at(step, 0);
  int doubtful = 0;
  TRY(values_of_kinks(step, at, value));
  *unknown = 0;
  for (int k = 0; k < EVENT_KINKS; k++) {
    const real g = value[EVENT_FIRST[FIRST_KINK + k]], side = SIDE_OF(step->watch, k);
    step->watch->acts[FIRST_KINK + k] = 1;
    step->own[MODE_PLACE[FIRST_SIDE + k]] = side;
    doubtful |= !((g > 0.0 && side > 0.0) || (g < 0.0 && side < 0.0));
  }
  if (doubtful)
    TRY(rounding_of(step, at));
  for (int k = 0; doubtful && k < EVENT_KINKS; k++) {
    const int side = side_of(step, k, value);
    if (side)
      set_side(step, k, side);
    *unknown += SIDE_OF(step->watch, k) == 0.0;
  }
  return OK;
}

/* Signs of the functions of all kinks after small parts of a step from a state, by the sides that are set: at the first
 * of them where each is beyond rounding; 0 if none is. */
static int signs_after(const event_step *step, const event_sample *at, real length, int *sign)
{
  event_step from = *step;
  event_sample next;
  real *const value = values_at(step, EVENT_DEGREE + 1);
  int unknown = EVENT_KINKS;
  from.t = at->t;
  from.h = length;
  from.q = at->q;
  from.p = at->p;
  memset(sign, 0, sizeof(int) * EVENT_KINKS);
  for (int place = KINK_FIRST_PROBE; unknown > 0 && place >= KINK_LAST_PROBE; place -= 5) {
    TRY(state_at(&from, ldexp(1.0, -place), &next));
    TRY(values_of_kinks(&from, &next, value));
    unknown = 0;
    for (int k = 0; k < EVENT_KINKS; k++) {
      sign[k] = sign[k] ? sign[k] : side_of(step, k, value);
      unknown += sign[k] == 0;
    }
  }
  return OK;
}

/* Sides of the kinks at whose zeros a run starts: those after a small part of its first step by the formula. A function
 * that stays within rounding has the side of its value, 1 for 0 as unit_step(0) = 1: another sign is a crossing. */
static int sides_after_start(const event_step *step, const event_sample *at, real length)
{
  int sign[EVENT_KINKS];
  TRY(signs_after(step, at, length, sign));
  for (int k = 0; k < EVENT_KINKS; k++)
    if (SIDE_OF(step->watch, k) == 0.0) {
      const real value = values_at(step, 0)[EVENT_FIRST[FIRST_KINK + k]];
      set_side(step, k, sign[k] < 0 || (sign[k] == 0 && value < 0.0) ? -1 : 1);
    }
  return OK;
}

/* Fails where the motion slides on the zero of a kink, unless the run ends there. */
static int slides(const event_step *step, int event, const event_sample *at)
{
  if (step->watch->ended)
    return OK;
  step->watch->sliding = event + 1;
  step->report->t = at->t;
  return NOT_CONVERGED;
}

/* The same where no step by the formula exists, as of forces that point to a surface: side 1, or -1 if the motion of
 * side 1 leaves to it. If that of side -1 returns, it slides. */
static int sides_at_jump(const event_step *step, const event_sample *at, real length)
{
  int sign[EVENT_KINKS], starts[EVENT_KINKS];
  for (int k = 0; k < EVENT_KINKS; k++) {
    starts[k] = SIDE_OF(step->watch, k) == 0.0;
    if (starts[k])
      set_side(step, k, 1);
  }
  for (int pass = 0; pass < 2; pass++) {
    TRY(signs_after(step, at, length, sign));
    for (int k = 0; k < EVENT_KINKS; k++) {
      if (!starts[k] || sign[k] * SIDE_OF(step->watch, k) >= 0.0)
        continue;
      set_side(step, k, -1);
      if (pass)
        return slides(step, FIRST_KINK + k, at);
    }
  }
  return OK;
}

#ifdef EVENT_REFRACTS
/* Momenta beyond a surface u(q, t) = 0 where L jumps, by the corner conditions of Weierstrass and Erdmann: p+ = p- +
 * lambda n, n = u_q, H+(p+) - H-(p-) = -lambda u_t, n.v+ + u_t of the sign `toward`. H+ is convex along n: from that
 * side Newton's method decreases to the root, or passes the minimum if there is none; then *passes is 0. */
static int refract(const event_step *step, event_sample *at, const event_entries *wall, real before, int toward,
    int *passes)
{
  real *const v = step->memory + 3 * M;
  real lambda = 0.0, rate, start = 0.0, mass = 0.0;
  TRY(approach(step, at, wall, 0.0, v, &rate));
  TRY(energy_after(step, at, wall, 0.0, v, &start));
  if (!(toward * rate > 0.0)) { /* beyond the root of a quadratic energy */
    TRY(approach(step, at, wall, 1.0, v, &mass));
    mass = 1.0 / (mass - rate);
    lambda = toward * (2.0 * fabs(rate) * mass + sqrt(2.0 * fabs(mass * (start - before))));
  }
  TRY(solve_impulse(step, at, wall, start, before, toward, &lambda, passes));
  if (!*passes)
    return OK;
  for (int i = 0; i < wall->count; i++)
    at->p[wall->place[i]] += lambda * wall->value[i];
  return satisfy_constraints(step, at->t, at->q, at->p, 0);
}

/* Passes the surface of a crossing, or is reflected by it: an impact that conserves the energy, with the former side as
 * the direction of the crossing. A motion that returns without either touches it. */
static int pass_surface(const event_step *step, event_crossing *crossing, event_sample *at)
{
  const int kink = crossing->function - FIRST_KINK, direction = crossing->direction, e = FUNCTION_OF(crossing);
  event_entries wall;
  real before = 0.0;
  int sign[EVENT_KINKS], passes = 0;
  TRY(signs_after(step, at, step->whole, sign));
  if (sign[kink] != direction) {
    crossing->direction = 0;
    step->watch->history[e].hits = 1;
    return OK;
  }
  TRY(changes_at(step, e, at, &wall));
  TRY(energy_after(step, at, &wall, 0.0, step->memory + 3 * M, &before));
  set_side(step, kink, direction);
  TRY(refract(step, at, &wall, before, step->h < 0.0 ? -direction : direction, &passes));
  if (passes)
    return OK;
  set_side(step, kink, -direction);
  crossing->direction = -direction;
  const int status = impact(step, at, &wall);
  if (status == NOT_CONVERGED)
    step->watch->jammed = crossing->function + 1;
  return status;
}
#endif

/* Changes to the other side at the crossings from `first` on, which have one state. If the motion returns at once, it
 * touches the surface and keeps its side; if by the equations of that side it returns, too, it slides (A. F. Filippov,
 * Differential Equations with Discontinuous Righthand Sides, 1988). */
static int change_sides(const event_step *step, long long first, event_sample *at)
{
  int sign[EVENT_KINKS], changed = 0, returns = 0;
  for (long long i = first; i < *step->filled; i++)
    if (is_kink(step->found[i].function)) {
      if (!IS_WALL(step->found[i].function))
        set_side(step, step->found[i].function - FIRST_KINK, step->found[i].direction);
      changed = 1;
    }
  if (!changed)
    return OK;
  TRY(evaluate_functions(step, at, values_at(step, 0)));
  TRY(rounding_of(step, at));
#ifdef EVENT_REFRACTS
  for (long long i = first; i < *step->filled; i++)
    if (REFRACTS[step->found[i].function])
      TRY(pass_surface(step, step->found + i, at));
#endif
  TRY(signs_after(step, at, step->whole, sign));
  for (long long i = first; i < *step->filled; i++) {
    event_crossing *crossing = step->found + i;
    const int kink = crossing->function - FIRST_KINK;
    if (kink >= 0 && !IS_OF_TIME(kink) && !IS_WALL(crossing->function) && sign[kink] == -crossing->direction) {
      set_side(step, kink, -crossing->direction);
      crossing->direction = 0; /* a touch: many in what remains of a step do not accumulate */
      step->watch->history[FUNCTION_OF(crossing)].hits = 1;
      returns = 1;
    }
  }
  if (returns)
    TRY(signs_after(step, at, step->whole, sign));
  for (long long i = first; returns && i < *step->filled; i++) {
    const int kink = step->found[i].function - FIRST_KINK;
    if (kink >= 0 && step->found[i].direction == 0 && sign[kink] * SIDE_OF(step->watch, kink) < 0.0) {
      return slides(step, step->found[i].function, at);
    }
  }
  return OK;
}

/* Fails if a function has the sign of the other side at the end of a step in which no crossing was found. */
static int check_sides(const event_step *step, const event_sample *right)
{
  real *const value = values_at(step, EVENT_DEGREE);
  int doubtful = 0;
  TRY(values_of_kinks(step, right, value));
  for (int k = 0; k < EVENT_KINKS; k++)
    doubtful |= value[EVENT_FIRST[FIRST_KINK + k]] * (SIDE_OF(step->watch, k) / KINK_SIDE) < 0.0;
  if (!doubtful)
    return OK;
  memcpy(values_at(step, 0), value, BYTES(EVENTS));
  TRY(rounding_of(step, right));
  for (int k = 0; k < EVENT_KINKS; k++)
    if (side_of(step, k, value) * SIDE_OF(step->watch, k) < 0.0 &&
        fabs(value[EVENT_FIRST[FIRST_KINK + k]]) > KINK_MISSED * rounding_at(step, k)) {
      step->watch->through = FIRST_KINK + k + 1;
      return NOT_CONVERGED;
    }
  return OK;
}

#if defined(EVENT_POWERS) && EVENTS_CONTROLLED
/* Whether a power of the function of a kink acts on its side. */
static int has_power(const event_step *step, int kink)
{
  const real side = SIDE_OF(step->watch, kink);
  return side != 0.0 && HAS_POWER[kink][side > 0.0];
}

/* Whether a step begins at the zero of the base of a power, on its side. */
static int enters_power(const event_step *step)
{
  int enters = 0;
  for (int k = 0; k < EVENT_KINKS; k++)
    enters |= JUST_CHANGED(step->watch, EVENT_FIRST[FIRST_KINK + k]) && has_power(step, k);
  return enters;
}

/* Control of a step on the side of a power u^k that is not whole, whose solutions are not smooth at u = 0: its size is
 * at most a part of the time from or to there, until that is so short that the error of the last one is negligible. */
static const step_control *graded(const event_step *step, const step_control *control, step_control *shorter)
{
  const real last = pow(fmax(control->tolerance, DBL_EPSILON), GRADE_POWER);
  *shorter = *control;
  shorter->max_step = fmin(control->max_step, GRADE_FIRST * step->watch->first);
  for (int k = 0; k < EVENT_KINKS; k++) {
    const real size = fabs(values_at(step, 0)[EVENT_FIRST[FIRST_KINK + k]]), rate = step->watch->rate[k];
    real *const depth = step->watch->depth + k;
    if (!(step->watch->started && rate > 0.0 && has_power(step, k)))
      continue;
    *depth = fmax(*depth, size);
    shorter->max_step = fmin(shorter->max_step, fmax(GRADE * size, last * *depth) / rate);
  }
  return shorter;
}
#endif

/* Whether no kink is reached in a step: each function is farther from zero than KINK_FAR times its change, by the
 * control points of the cubic Hermite polynomial of a position, u(q0 + h v0 / 3) and u(q1 - h v1 / 3), and by its rate
 * of change in former steps. */
static int kinks_are_far(const event_step *step, const event_sample *left, const event_sample *right)
{
  const real *const before = values_at(step, 0), *const after = values_at(step, EVENT_DEGREE);
  real *const v = step->memory + 2 * M, third = step->h / 3.0;
  event_sample next = {.q = v + M};
  if (FIRST_KINK > 0 || !step->watch->started || ++step->watch->unsearched >= KINK_SEARCHES)
    return 0;
  for (int side = 0; side < 2; side++, third = -third) {
    const event_sample *const end = side ? right : left;
    if (event_velocity(end->t, end->q, end->p, step->parameters, v, step->workspace) != OK)
      return 0;
    next.t = end->t + third;
    next.p = end->p;
    for (int i = 0; i < M; i++)
      next.q[i] = end->q[i] + third * v[i];
    if (all_values(next.t, next.q, next.p, step->parameters, values_at(step, 1 + side), step->workspace) != OK)
      return 0;
  }
  for (int k = 0; k < EVENT_KINKS; k++) {
    const int e = EVENT_FIRST[FIRST_KINK + k];
#ifdef EVENTS_OF_TIME
    if (EVENTS_OF_TIME_ALONE || IS_TIMED[FIRST_KINK + k] == 1)
      return 0;
#endif
    const real first = values_at(step, 1)[e], last = values_at(step, 2)[e], rate = step->watch->rate[k];
    const real low = fmin(fmin(before[e], after[e]), fmin(first, last));
    const real high = fmax(fmax(before[e], after[e]), fmax(first, last));
    const real change = fmax(high - low, rate * fabs(step->h));
    if (!(low > KINK_FAR * change || -high > KINK_FAR * change))
      return 0;
    step->watch->rate[k] = KINK_FORGETS * change / fabs(step->h);
  }
  return 1;
}

/* Notes the rates of change of the functions of kinks in a step that was searched. */
static void note_rates(const event_step *step)
{
  step->watch->unsearched = 0;
#ifdef EVENTS_OF_TIME
  if (EVENTS_OF_TIME_ALONE)
    return; /* without values within the step */
#endif
  for (int k = 0; k < EVENT_KINKS; k++) {
    const int e = EVENT_FIRST[FIRST_KINK + k];
    real low = INFINITY, high = -INFINITY;
    for (int j = 0; j <= EVENT_DEGREE; j++) {
      low = fmin(low, values_at(step, j)[e]);
      high = fmax(high, values_at(step, j)[e]);
    }
    step->watch->rate[k] = fmax(KINK_FORGETS * step->watch->rate[k], (high - low) / fabs(step->h));
  }
}
#endif
