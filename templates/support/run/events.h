#include "../core/numbers.h"
#include "../core/status_codes.h"
#include "event_polynomials.h"

/* Location of zero crossings of event functions, by the public functions of the integrator alone.
 *
 * A step is sampled at Chebyshev nodes; the interpolating polynomial separates the crossings, which are then enclosed
 * by a secant iteration on partial steps. Requires: numbers.h, BYTES, parts/event_functions.c.jinja;
 * EVENT_NODES, the nodes as fractions of a part of a step. */
enum {
  EVENT_SPLITS = 6, /* greatest depth of subdivision of a step */
  EVENT_OCTAVES = 10, /* intervals of a part of a step after a kink */
  EVENT_TRIALS = 200, /* largest number of states evaluated for one crossing; bisection takes 52 */
  EVENT_FIRST_PROBE = 40, /* after a start at a zero, the first state tested is 2^-40 of a step later */
  EVENT_LAST_PROBE = 4,
  EVENT_NO_ROOM = -1
};

#define EVENT_TIE 0x1p-30 /* relative to the step: closer crossings may coincide */
#define EVENT_SAME_TIME (8.0 * DBL_EPSILON) /* relative to the time: rounding of a zero of a function of time */
#define EVENT_AT_ZERO (16.0 * DBL_EPSILON) /* relative to the range of a function on a whole step: residual of a
                                            * located zero */
#define EVENT_UNCHANGED (4.0 * DBL_EPSILON) /* relative to the range of a function on a step: a change that may be
                                           * rounding */
#define EVENT_SMALL_PART 0.03 /* a polynomial whose error estimate is less than this part of its range is accepted */
#define EVENT_FAR 32.0 /* a function is far from zero beyond so many times its range at the nodes: polynomials and their
                        * error estimates deviate by at most 22 of them */
#define EVENT_SINGLE 8 /* coordinates whose rounding is examined one by one */
#define EVENT_FEW 16 /* functions that are all examined after a change */
#define EVENT_OVERSHOOT 0x1p-10 /* part of a secant step by which it is longer, so that the sign changes */

/* Whether the state where a search starts is that of the last change by function e, within rounding of its zero. */
#ifdef EVENT_CHANGES
#define JUST_CHANGED(watch, e) ((watch)->history[e].hits > 0 && (watch)->history[e].last == (watch)->time)
#define RESIDUAL(watch, e) (JUST_CHANGED(watch, e) ? 2.0 * (watch)->history[e].slack : 0.0) /* of the located zero */
#else
#define JUST_CHANGED(watch, e) 0
#define RESIDUAL(watch, e) 0.0
#endif
#define SIDE_OF(watch, kink) ((watch)->mode[FIRST_SIDE + (kink)])
#define FUNCTION_OF(crossing) ((int)(EVENT_FIRST[(crossing)->function] + (crossing)->element))

#ifdef EVENT_MODES
/* Puts modes among the parameters of steps. */
static void put_modes(const real *mode, real *parameters)
{
  for (int k = 0; k < EVENT_MODES; k++)
    parameters[MODE_PLACE[k]] = mode[k];
}
#endif

/* Whether an event is a transition of a contact, whose function is >= 0 in its mode. */
static inline int is_transition(int event)
{
#ifdef EVENT_CONTACTS
  return event >= FIRST_TRANSITION && event < FIRST_TRANSITION + TRANSITIONS;
#else
  return 0;
#endif
}

/* Side on which the motion is beside a zero of function e, > 0 or < 0: of kinks and transitions; 0 for others. */
static inline real side_at_start(const event_watch *watch, int e)
{
#ifdef EVENT_KINKS
  if (EVENT_OF(e) >= FIRST_KINK)
    return SIDE_OF(watch, EVENT_OF(e) - FIRST_KINK);
#endif
  return is_transition(EVENT_OF(e)) ? 1.0 : 0.0;
}

/* A function at a fraction of a step, and the state there, in memory that later samples may use as well. */
typedef struct {
  real fraction, t, g, *q, *p;
} event_sample;

/* A step that is searched, and the array for its crossings. */
typedef struct {
  real t, h, whole; /* of a part of a step; of the whole step */
  const real *q, *p, *parameters;
  const solver_options *options;
  event_watch *watch;
  event_crossing *found;
  long long room, *filled;
  solver_report *report;
  real *workspace;
  real *memory; /* state of the last sample (2 M), work (5 M), state of the horizon (2 M); those of changes */
  real *values; /* of the functions (EVENT_VALUES EVENTS) */
  int rounding_known; /* whether the effect of rounding on this step is */
  event_sample *horizon; /* first known crossing that changes the state; later ones are not located */
  real *own; /* the parameters, with the modes of kinks */
} event_step;

#ifdef CONTACTS_LOCATED
static int rounding_of_contact(const event_step *step, int event, const event_sample *at, real *rounding);
#endif

/* Values of all functions at a node, at a state (EVENT_DEGREE + 1), and the effect of rounding (EVENT_DEGREE + 2). */
static real *values_at(const event_step *step, int row)
{
  return step->values + (long long)row * EVENTS;
}

/* Evaluates all functions at the state of a sample; watch->undefined is 1 + the event of the first that is not
 * finite. */
static int evaluate_functions(const event_step *step, const event_sample *at, real *value)
{
  TRY(all_values(at->t, at->q, at->p, step->parameters, value, step->workspace));
  for (int e = 0; e < EVENTS; e++)
    if (!is_finite(value[e])) {
      step->watch->undefined = EVENT_OF(e) + 1;
      return NOT_FINITE;
    }
  return OK;
}

/* Evaluates function e at the state of a sample. */
static int evaluate_function(const event_step *step, int e, event_sample *at)
{
  TRY(one_value(e, at->t, at->q, at->p, step->parameters, &at->g, step->workspace));
  if (!is_finite(at->g)) {
    step->watch->undefined = EVENT_OF(e) + 1;
    return NOT_FINITE;
  }
  return OK;
}

/* Computes the state at a fraction of the step by one step of that size. */
static int state_at(const event_step *step, real fraction, event_sample *sample)
{
  solver_report own;
  int status;
  sample->q = step->memory;
  sample->p = step->memory + M;
  status = NAME(step)(step->t, fraction * step->h, step->q, step->p, step->parameters, step->options, sample->q,
      sample->p, &own, step->workspace);
  sample->fraction = fraction;
  sample->t = step->t + duration_of_part(fraction * step->h, &own);
  step->report->iterations += own.iterations;
  step->report->change = own.change;
  return status;
}

/* Computes the sample of function e at a fraction of the step. */
static int take_sample(const event_step *step, int e, real fraction, event_sample *sample)
{
  TRY(state_at(step, fraction, sample));
  return evaluate_function(step, e, sample);
}

/* Narrows a sign change to neighbouring fractions; high is the later end, `guess` its approximation or NAN. Secant
 * steps from the end nearer to zero pass the crossing by a small part, so that both ends approach it; an interval that
 * is not halved by two of them is bisected. *sampled is the fraction of the last sample. */
static int enclose_crossing(const event_step *step, int e, event_sample low, event_sample *high, real guess,
    real *sampled)
{
  const real least = 2.0 * DBL_EPSILON;
  real quotient = 0.0, wide = INFINITY, wider = INFINITY;
  for (int k = 0; k < EVENT_TRIALS && high->g != 0.0 && high->fraction - low.fraction > 2.0 * least; k++) {
    const real width = high->fraction - low.fraction, mean = (high->g - low.g) / width;
    const event_sample near = fabs(high->g) < fabs(low.g) ? *high : low;
    real fraction = guess;
    event_sample now;
    if (k > 0 || !(guess > low.fraction && guess < high->fraction)) {
      const real move = -near.g / (quotient * mean > 0.0 ? quotient : mean);
      fraction = near.fraction + move + copysign(fmax(1.5 * least, EVENT_OVERSHOOT * fabs(move)), move);
    }
    if (width > 0.5 * wider)
      fraction = low.fraction + 0.5 * width;
    wider = wide;
    wide = width;
    fraction = fmin(fmax(fraction, low.fraction + least), high->fraction - least);
    TRY(take_sample(step, e, fraction, &now));
    *sampled = fraction;
    quotient = (now.g - near.g) / (fraction - near.fraction);
    if (changes_sign(low.g, now.g))
      *high = now;
    else
      low = now;
  }
  return OK;
}

/* Adds the crossing between two samples if its direction is requested and it is not behind the horizon, which is then
 * the crossing if it changes the state. */
static int add_crossing(const event_step *step, int e, const event_sample *from, const event_sample *to, real guess)
{
  const int direction = from->g < 0.0 ? 1 : -1, event = EVENT_OF(e);
  event_sample at = *to, *const horizon = step->horizon;
  event_crossing *crossing = step->found + *step->filled;
  real sampled = NAN;
  int open;
  if (step->watch->direction[event] == -direction || from->fraction >= horizon->fraction)
    return OK;
  if (to->fraction > horizon->fraction) {
    at = *horizon;
    TRY(evaluate_function(step, e, &at));
    if (!changes_sign(from->g, at.g))
      return OK;
  }
  if (*step->filled == step->room)
    return EVENT_NO_ROOM;
  TRY(enclose_crossing(step, e, *from, &at, guess, &sampled));
  if (at.q == step->memory && at.fraction != sampled)
    TRY(take_sample(step, e, at.fraction, &at));
  TRY(conditions(e, at.t, at.q, at.p, step->parameters, &open, step->workspace));
  if (!open)
    return OK;
  if (!place_crossing(step->watch, crossing, step->room))
    return EVENT_NO_ROOM;
  crossing->t = at.t;
  crossing->fraction = at.fraction;
  crossing->function = event;
  crossing->element = e - EVENT_FIRST[event];
  crossing->direction = direction;
  copy_state(crossing->q, crossing->p, at.q, at.p);
  ++*step->filled;
  if (step->watch->acts[event]) {
    horizon->fraction = at.fraction;
    horizon->t = at.t;
    copy_state(horizon->q, horizon->p, crossing->q, crossing->p);
  }
  return OK;
}

/* Adds the crossings of one function between two samples, with samples at the extrema between them; zeros: fractions of
 * the crossings of the polynomial, at most one between neighbouring extrema. */
static int add_crossings(const event_step *step, int e, const event_sample *left, const event_sample *right,
    const real *extrema, int count, const real *zeros, int zero_count)
{
  event_sample from = *left, to;
  for (int i = 0; i <= count; i++) {
    if (i < count && extrema[i] < step->horizon->fraction) {
      TRY(take_sample(step, e, extrema[i], &to));
    } else if (i < count) { /* later crossings are not required */
      i = count;
      to = *step->horizon;
      TRY(evaluate_function(step, e, &to));
    } else {
      to = *right;
    }
    if (changes_sign(from.g, to.g)) {
      real guess = NAN;
      for (int k = 0; k < zero_count; k++)
        guess = zeros[k] > from.fraction && zeros[k] < to.fraction ? zeros[k] : guess;
      TRY(add_crossing(step, e, &from, &to, guess));
    }
    from = to;
  }
  return OK;
}

/* Searches a part of a step for crossings of one function; `known` are its values at the inner nodes, or NULL. The part
 * is split in the middle if the polynomial does not approximate the function, and at an extremum so near zero that its
 * sign is uncertain. */
static int search_part(const event_step *step, int e, const event_sample *left, const event_sample *right,
    const real *known, int splits)
{
  const real half = 0.5 * (right->fraction - left->fraction), middle = left->fraction + half;
  real g[EVENT_DEGREE + 1], c[EVENT_DEGREE + 1], extrema[EVENT_DEGREE], zeros[EVENT_DEGREE];
  real doubt, range, split, before = left->g;
  int count, zero_count, follows, crossed = 0;
  event_sample sample;
  if (left->fraction >= step->horizon->fraction)
    return OK;
  g[0] = left->g;
  g[EVENT_DEGREE] = right->g;
  for (int j = 1; j < EVENT_DEGREE; j++) {
    if (!known)
      TRY(take_sample(step, e, left->fraction + EVENT_NODES[j] * 2.0 * half, &sample));
    g[j] = known ? known[j - 1] : sample.g;
  }
  interpolate(g, c, &doubt, &range);
  follows = doubt <= EVENT_SMALL_PART * range;
  if (!changes_sign(left->g, right->g) && fabs(c[0]) > range + (follows ? doubt : range))
    return OK; /* far from zero */
  split = uncertain_abscissa(c, doubt, extrema, &count, zeros, &zero_count);
  if (split < 1.0 || !follows)
    split = split > 1.0 ? 0.0 : fmin(fmax(split, -0.5), 0.5);
  for (int i = 0; i <= count; i++) {
    const real value = i < count ? polynomial(c, EVENT_DEGREE, extrema[i]) : g[EVENT_DEGREE];
    crossed |= changes_sign(before, value);
    before = value;
    if (i < count)
      extrema[i] = middle + half * extrema[i];
  }
  for (int i = 0; i < zero_count; i++)
    zeros[i] = middle + half * zeros[i];
  if (split > 1.0 || splits == 0)
    return crossed || split < 1.0 ? add_crossings(step, e, left, right, extrema, count, zeros, zero_count) : OK;
  TRY(take_sample(step, e, middle + half * split, &sample));
  TRY(search_part(step, e, left, &sample, NULL, splits - 1));
  return search_part(step, e, &sample, right, NULL, splits - 1);
}

/* Changes of the functions if each coordinate and its momentum change by one ulp: the effect of rounding of the state.
 * Of many the largest change if all of them change at once, with alternating signs of three patterns. */
static int rounding_of(const event_step *step, const event_sample *at)
{
  real *const noise = values_at(step, EVENT_DEGREE + 2), *const now = values_at(step, EVENT_DEGREE + 1);
  const real *const before = values_at(step, 0);
  const int each = M <= EVENT_SINGLE;
  event_sample next = *at;
  next.q = step->memory + 2 * M;
  next.p = next.q + M;
  memset(noise, 0, BYTES(EVENTS));
  for (int k = 0; k < (each ? M : 3); k++) {
    for (int i = 0; i < M; i++) {
      const int sign = (i * k / 2) % 2 ? -1 : 1, ulps = each ? i == k : sign;
      next.q[i] = at->q[i] * (1.0 + ulps * DBL_EPSILON);
      next.p[i] = at->p[i] * (1.0 + ulps * DBL_EPSILON);
    }
    TRY(evaluate_functions(step, &next, now));
    for (int e = 0; e < EVENTS; e++)
      noise[e] = each ? noise[e] + fabs(now[e] - before[e]) : fmax(noise[e], fabs(now[e] - before[e]));
  }
#ifdef EVENTS_OF_TIME
  for (int e = 0; e < EVENTS; e++)
    if (IS_TIMED[EVENT_OF(e)]) {
      real reach[3];
      TRY(time_reach(e, at->t, 0.0, step->parameters, reach, step->workspace));
      noise[e] = DBL_EPSILON * reach[2];
    }
#endif
  return OK;
}

/* Central difference of a function along (q, p, t), divided by the size of the change; dq or dp NULL: zeros. */
static int difference(const event_step *step, int e, const event_sample *at, const real *dq, const real *dp, real dt,
    real size, real *found)
{
  event_sample ends[2] = {*at, *at};
  for (int side = 0; side < 2; side++) {
    const real part = side ? size : -size;
    ends[side].q = step->memory;
    ends[side].p = step->memory + M;
    for (int i = 0; i < M; i++) {
      ends[side].q[i] = at->q[i] + (dq ? part * dq[i] : 0.0);
      ends[side].p[i] = at->p[i] + (dp ? part * dp[i] : 0.0);
    }
    ends[side].t += part * dt;
    TRY(evaluate_function(step, e, ends + side));
  }
  *found = (ends[1].g - ends[0].g) / (2.0 * size);
  return OK;
}

/* dg = (g_q v + g_p p_dot + g_t) h, the change of a function in a step at its initial rate, and its uncertainty. The
 * difference along q is as long as rounding of q requires; those along p and t may be shorter. */
static int first_change(const event_step *step, int e, const event_sample *at, real noise, real *change, real *doubt)
{
  const real little = 0x1p-10;
  real *const v = step->memory + 2 * M, *const dq = v + M, *const dp = dq + M;
  real fast = 0.0, large = 0.0, size, by_q = 0.0, by_rest = 0.0;
  event_sample next;
  TRY(event_velocity(at->t, at->q, at->p, step->parameters, v, step->workspace));
  TRY(state_at(step, little, &next));
  for (int i = 0; i < M; i++) {
    dq[i] = v[i] * (next.t - at->t) / little;
    dp[i] = (next.p[i] - at->p[i]) / little;
    fast = fmax(fast, fabs(dq[i]));
    large = fmax(large, fabs(at->q[i]));
  }
  size = fast > 0.0 && 0x1p-17 * large / fast > little ? 0x1p-17 * large / fast : little;
  TRY(difference(step, e, at, dq, NULL, 0.0, size, &by_q));
  TRY(difference(step, e, at, NULL, dp, (next.t - at->t) / little, little, &by_rest));
  *change = by_q + by_rest;
  *doubt = noise / size + (by_rest != 0.0 ? noise / little : 0.0);
  return OK;
}

/* Start of the search in a first step. A run that ended at a zero and restarts there, e.g. after a rebound, may be on
 * the near side of the zero by a rounding error, or exactly on it; if it leaves to the other side and returns within
 * the step, the signs at both ends do not reveal the crossing. States after the start, each four times as far as the
 * previous one, are tested until one is beyond rounding, then until the function returns. If it returns before the
 * first of these states, crossings accumulate (Zeno) and NOT_CONVERGED is returned. */
static int leave_zero(const event_step *step, int e, const event_sample *left, real range, event_sample *from)
{
  event_sample next;
  real noise = values_at(step, EVENT_DEGREE + 2)[e], change, doubt;
  int sign, place = EVENT_FIRST_PROBE, away = 0, event = EVENT_OF(e);
  if (fabs(left->g) > EVENT_AT_ZERO * range * fabs(step->whole / step->h) + 8.0 * noise + RESIDUAL(step->watch, e))
    return OK;
  if (first_change(step, e, left, noise, &change, &doubt) != OK) {
    step->watch->undefined = 0; /* the rate is not defined at this state */
    return OK;
  }
  sign = change > 0.0 ? 1 : -1;
  if (fabs(change) <= EVENT_UNCHANGED * range + 4.0 * doubt || sign * left->g > 0.0)
    return OK;
  /* g = x dg + x^2 c with g >= x dg / 2 at the last of these states does not return before 2 x */
  TRY(take_sample(step, e, ldexp(1.0, -EVENT_LAST_PROBE), &next));
  if (sign * next.g >= ldexp(0.5 * fabs(change), -EVENT_LAST_PROBE) && sign * next.g > 8.0 * noise) {
    if (changes_sign(from->g, next.g) && !JUST_CHANGED(step->watch, e))
      TRY(add_crossing(step, e, from, &next, NAN));
    from->g = sign * fabs(from->g);
    return OK;
  }
  for (; place >= EVENT_LAST_PROBE; place -= 2) {
    TRY(take_sample(step, e, ldexp(1.0, -place), &next));
    if (!away && fabs(next.g) <= 8.0 * noise + 4.0 * fabs(left->g))
      continue;
    if (!away && sign * next.g < 0.0 && (step->watch->remaining[event] > 0 || step->watch->acts[event]) &&
        step->watch->direction[event] != sign) {
      step->watch->accumulated = event + 1;
      return NOT_CONVERGED;
    }
    away = 1;
    if (changes_sign(from->g, next.g) && !(from->fraction == 0.0 && JUST_CHANGED(step->watch, e)))
      TRY(add_crossing(step, e, from, &next, NAN));
    *from = next;
  }
  return OK;
}

/* Start of the search in a part that begins at a zero to whose known side the motion goes: the last of a few states
 * that are within rounding of zero, or the first beyond on that side. */
static int leave_to_side(const event_step *step, int e, const event_sample *left, event_sample *from)
{
  static const int PLACES[2][4] = {{4, 6, 8, 10}, {16, 24, 32, 40}};
  const real side = side_at_start(step->watch, e);
  const real noise = 8.0 * values_at(step, EVENT_DEGREE + 2)[e] + RESIDUAL(step->watch, e);
  const real tiny = copysign(DBL_MIN, side);
  event_sample next = *left;
  int away = 0, remains = EVENT_DEGREE;
  while (remains >= 0 && !is_transition(EVENT_OF(e)) && fabs(values_at(step, remains)[e]) <= noise)
    remains--;
  if (remains < 0)
    from->fraction = 1.0; /* on the surface: nothing to search */
  if (remains < 0 || fabs(left->g) > noise)
    return OK;
  from->g = tiny;
  for (int k = 3; k >= 0 && !away; k--) {
    TRY(take_sample(step, e, ldexp(1.0, -PLACES[0][k]), &next));
    away = fabs(next.g) > noise;
    *from = next;
    from->g = away ? next.g : tiny;
  }
  for (int k = 0; k < 4 && changes_sign(tiny, from->g); k++) {
    TRY(take_sample(step, e, ldexp(1.0, -PLACES[1][k]), &next));
    *from = next;
    from->g = fabs(next.g) > noise ? next.g : tiny;
  }
  if (changes_sign(tiny, from->g))
    from->g = tiny;
  return OK;
}

/* Search in a part that begins at a kink or a start, from twice as long to twice as long intervals, so that the first
 * of many crossings is found. */
static int search_octaves(const event_step *step, int e, const event_sample *from, const event_sample *right)
{
  event_sample low = *from, high;
  for (int k = EVENT_OCTAVES; k >= 0 && low.fraction < step->horizon->fraction; k--) {
    const real fraction = ldexp(1.0, -k);
    if (fraction <= low.fraction)
      continue;
    high = *right;
    if (k > 0)
      TRY(take_sample(step, e, fraction, &high));
    TRY(search_part(step, e, &low, &high, NULL, EVENT_SPLITS));
    low = high;
  }
  return OK;
}

/* Marks the functions that are far from zero along a step, as search_part would find, in a loop over all of them. */
static void mark_far(const event_step *step, real *far)
{
  const long long count = EVENTS;
  const real at_zero = EVENT_AT_ZERO * fabs(step->whole / step->h);
  const real *const value = values_at(step, 0), *const noise = values_at(step, EVENT_DEGREE + 2);
  for (long long e = 0; e < count; e++) {
    real c[EVENT_DEGREE + 1], range = 0.0, doubt;
    for (int k = 0; k <= EVENT_DEGREE; k++) {
      c[k] = 0.0;
      for (int j = 0; j <= EVENT_DEGREE; j++)
        c[k] += EVENT_COEFFICIENTS[k][j] * value[j * count + e];
      range += k > 0 ? fabs(c[k]) : 0.0;
    }
    doubt = EVENT_DOUBTS[0] * fabs(c[EVENT_DEGREE - 1]) + EVENT_DOUBTS[1] * fabs(c[EVENT_DEGREE]);
    far[e] = fabs(c[0]) > (1.0 + EVENT_TIE) * range + (doubt <= EVENT_SMALL_PART * range ? doubt : range) ? 1.0 : 0.0;
  }
  for (long long e = 0; e < count && !step->watch->started; e++)
    if (fabs(value[e]) <= at_zero * fabs(value[EVENT_DEGREE / 2 * count + e]) + 8.0 * noise[e])
      far[e] = 0.0;
}

/* Function that changes the state and first changes its sign, by the values at the nodes; -1: none. */
static int first_to_change(const event_step *step, const real *far)
{
  int first = -1;
  real least = INFINITY;
  for (int e = 0; e < EVENTS; e++)
    for (int j = far[e] == 0.0 && step->watch->acts[EVENT_OF(e)] ? 1 : EVENT_DEGREE + 1; j <= EVENT_DEGREE; j++) {
      const real from = values_at(step, j - 1)[e], to = values_at(step, j)[e];
      const real fraction = EVENT_NODES[j - 1] + from / (from - to) * (EVENT_NODES[j] - EVENT_NODES[j - 1]);
      if (changes_sign(from, to) && fraction < least) {
        least = fraction;
        first = e;
      }
    }
  return first;
}

/* Finds the crossings of one function on a step. */
static int search_function(const event_step *step, int e, const event_sample *left, const event_sample *right)
{
  event_sample start = *left, from, to = *right;
  int starts = !step->watch->started;
  real inner[EVENT_DEGREE - 1], middle = values_at(step, EVENT_DEGREE / 2)[e], range = 0.0, largest = 0.0;
  start.g = values_at(step, 0)[e];
  to.g = values_at(step, EVENT_DEGREE)[e];
  for (int j = 1; j < EVENT_DEGREE; j++)
    inner[j - 1] = values_at(step, j)[e];
  for (int j = 0; j <= EVENT_DEGREE; j++)
    range = fmax(range, fabs(values_at(step, j)[e] - middle));
  for (int j = 0; j <= EVENT_DEGREE; j++)
    largest = fmax(largest, fabs(values_at(step, j)[e]));
  if (fabs(middle) > EVENT_FAR * range)
    return OK; /* far from zero */
#ifdef EVENT_CHANGES
  if (IS_IMPACT[EVENT_OF(e)] && step->watch->history[e].hits > 0 && largest <= step->watch->history[e].slack)
    return OK; /* at zero since an impact without restitution */
#endif
#ifdef CONTACTS_LOCATED
  if (is_transition(EVENT_OF(e))) {
    real *const noise = values_at(step, EVENT_DEGREE + 2) + e, rounding;
    TRY(rounding_of_contact(step, EVENT_OF(e), left, &rounding));
    *noise = step->watch->started ? rounding : fmax(*noise, rounding);
    if (largest <= 8.0 * *noise)
      return OK; /* at zero, as the gap of bodies that rest side by side, or forces of joints in free fall */
    starts |= rounding > 0.0 && start.g <= 0.0 && -start.g <= 8.0 * rounding;
  }
#endif
  from = start;
  if (starts && side_at_start(step->watch, e) != 0.0) {
    TRY(leave_to_side(step, e, &start, &from));
  } else if (starts) {
    range = fabs(to.g - from.g);
    for (int j = 1; j < EVENT_DEGREE; j++)
      range = fmax(range, fabs(inner[j - 1] - from.g));
    TRY(leave_zero(step, e, &start, range, &from));
  }
  if (starts && !is_transition(EVENT_OF(e)) && side_at_start(step->watch, e) != 0.0)
    return search_octaves(step, e, &from, &to);
  return search_part(step, e, &from, &to, from.fraction > 0.0 ? NULL : inner, EVENT_SPLITS);
}

#ifdef EVENTS_OF_TIME
#include "event_times.h"
#endif

/* Finds the crossings of all functions on a step, in no particular order; the values at its ends are known. The first
 * one that changes the state is located first, as no later one is needed. */
static int search_step(const event_step *step, const event_sample *left, const event_sample *right)
{
  real *const far = values_at(step, EVENT_DEGREE + 1);
  int first;
  event_sample sample;
  step->horizon->fraction = INFINITY;
#ifdef EVENTS_OF_TIME
  for (int e = 0; e < EVENTS; e++)
    if (IS_TIMED[EVENT_OF(e)])
      TRY(search_times(step, e, left, right));
  if (EVENTS_OF_TIME_ALONE)
    return OK;
#endif
  for (int j = 1; j < EVENT_DEGREE; j++) {
    TRY(state_at(step, EVENT_NODES[j], &sample));
    TRY(evaluate_functions(step, &sample, values_at(step, j)));
  }
  if (!step->watch->started && !step->rounding_known)
    TRY(rounding_of(step, left));
  mark_far(step, far);
#ifdef EVENTS_OF_TIME
  for (int e = 0; e < EVENTS; e++)
    far[e] = IS_TIMED[EVENT_OF(e)] ? 1.0 : far[e];
#endif
  first = first_to_change(step, far);
  if (first >= 0)
    TRY(search_function(step, first, left, right));
  for (int e = 0; e < EVENTS; e++)
    if (e != first && far[e] == 0.0)
      TRY(search_function(step, e, left, right));
  return OK;
}

/* Counts a crossing; returns 1 if it ends the search, or changes the state. */
static int ends_search(event_watch *watch, const event_crossing *crossing)
{
  int *remaining = watch->remaining + crossing->function;
  watch->ended |= *remaining > 0 && --*remaining == 0;
  return watch->ended || watch->acts[crossing->function];
}

/* Evaluates function e at the state where a part of a step ends. */
static int value_at_end(const event_step *step, int e, event_sample *at)
{
#ifdef EVENTS_OF_TIME
  if (IS_TIMED[EVENT_OF(e)])
    return end_value(step, e, at->t, step->h, &at->g);
#endif
  return evaluate_function(step, e, at);
}

/* After the crossing that ends the search, keeps those of other functions that have already changed sign at its state:
 * a search from there would not find them. */
static int keep_coincident(const event_step *step, long long last)
{
  const long long filled = *step->filled;
  event_crossing end = step->found[last];
  event_sample at = {.t = end.t, .q = end.q, .p = end.p};
  *step->filled = last + 1;
  for (long long i = last + 1; i < filled; i++) {
    event_crossing other = step->found[i];
    if (other.fraction - end.fraction <= EVENT_TIE)
      TRY(value_at_end(step, FUNCTION_OF(&other), &at));
    if (other.fraction - end.fraction > EVENT_TIE || (real)other.direction * at.g < 0.0)
      continue;
    ends_search(step->watch, &other);
    other.t = end.t;
    other.fraction = end.fraction;
    copy_state(other.q, other.p, end.q, end.p);
    step->found[(*step->filled)++] = other;
  }
  return OK;
}

/* Sorts the crossings of one step by their fractions, as times may coincide, and drops those after the one that ends
 * the search or changes the state. */
static int settle_crossings(const event_step *step, long long first)
{
  for (long long i = first + 1; i < *step->filled; i++)
    for (long long k = i; k > first && step->found[k].fraction < step->found[k - 1].fraction; k--) {
      const event_crossing later = step->found[k - 1];
      step->found[k - 1] = step->found[k];
      step->found[k] = later;
    }
  for (long long i = first; i < *step->filled; i++)
    if (ends_search(step->watch, step->found + i))
      return keep_coincident(step, i);
  return OK;
}

int NAME(crossings)(event_watch *watch, long long count, const real *h, const real *t, const real *q,
    const real *p, const real *parameters, const solver_options *options, long long room,
    event_crossing *found, long long *filled, solver_report *report, real *workspace)
{
  EVENT_MEMORY(watch, memory, 9 * M)
  event_sample left, right, horizon = {.q = memory + 7 * M, .p = memory + 8 * M};
  memset(report, 0, sizeof *report);
  *filled = 0;
  for (long long k = 0; k < count && !watch->ended; k++) {
    const long long start = k > 0 ? k - 1 : 0, first = *filled;
    const event_step step = {t[start], h[start], h[start], q + start * M, p + start * M, parameters, options, watch,
        found, room, filled, report, workspace, memory, memory + 9 * M, 0, &horizon, NULL};
    int status;
    report->t = t[start];
    right.fraction = k > 0 ? 1.0 : 0.0;
    right.t = t[k];
    right.q = (real *)(q + k * M); /* not changed */
    right.p = (real *)(p + k * M);
    if (k > 0)
      memcpy(values_at(&step, 0), values_at(&step, EVENT_DEGREE), BYTES(EVENTS));
    status = evaluate_functions(&step, &right, values_at(&step, EVENT_DEGREE));
    if (status == OK && k > 0) {
      left.fraction = 0.0;
      status = search_step(&step, &left, &right);
    }
    if (status != OK) {
      *filled = first;
      return status == EVENT_NO_ROOM ? OK : status;
    }
    TRY(settle_crossings(&step, first));
    watch->started |= k > 0;
    report->steps = k;
    left = right;
  }
  return OK;
}

#ifdef EVENT_CHANGES
#define CHANGE_WHOLE 1e-9 /* relative to a step: a difference of its end from t_end that is rounding */

/* Arrays for the states of a call. */
typedef struct {
  long long states, *number;
  real *t, *q, *p, *length;
  int *iterations;
} stored_states;

static inline int store_state(const stored_states *to, const event_sample *at, real length, int iterations,
    long long number, solver_report *report)
{
  const long long k = report->stored;
  if (k == to->states)
    return EVENT_NO_ROOM;
  to->t[k] = at->t;
  to->length[k] = length;
  to->iterations[k] = iterations;
  to->number[k] = number;
  copy_state(to->q + k * M, to->p + k * M, at->q, at->p);
  report->stored++;
  return OK;
}

/* Sets the state of a run, without predictor and compensation terms. */
static inline void set_run(event_run *run, real t, const event_sample *at)
{
  run->t = t;
  copy_state(run->q, run->p, at->q, at->p);
  memset(run->carry_q, 0, BYTES(M));
  memset(run->carry_p, 0, BYTES(M));
  run->guess = 0;
}
#endif
