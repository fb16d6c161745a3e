#ifndef SUPPORT_EVENTS_H
#define SUPPORT_EVENTS_H

#include "../core/numbers.h"
#include "../core/status_codes.h"

/* Events: zero crossings of functions along the steps of a run; TIME_TRANSFORMATION: h is a step in tau. */
#ifdef TIME_TRANSFORMATION
/* Velocities dq/dt as arguments of event functions of a time-transformed system, whose integrator has dq/dtau, and the
 * duration of a part h of a step in tau. Requires: status_codes.h. */
static int event_velocity(real t, const real *q, const real *p, const real *parameters, real *v, real *workspace)
{
  real rate;
  int status = NAME(velocity)(t, q, p, parameters, v, workspace);
  if (status == OK)
    status = NAME(rates)(1, q, p, parameters, &rate);
  for (int i = 0; status == OK && i < M; i++)
    v[i] /= rate;
  return status;
}

static inline real duration_of_part(real h, const solver_report *part)
{
  (void)h;
  return part->duration;
}
#else
/* Velocities as arguments of event functions, and the duration of a part h of a step. Requires: status_codes.h. */
static int event_velocity(real t, const real *q, const real *p, const real *parameters, real *v, real *workspace)
{
  return NAME(velocity)(t, q, p, parameters, v, workspace);
}

static inline real duration_of_part(real h, const solver_report *part)
{
  (void)part;
  return h;
}
#endif

/* Location of zero crossings of event functions, by the public functions of the integrator alone.
 *
 * A step is sampled at Chebyshev nodes; the interpolating polynomial separates the crossings, which are then enclosed
 * by a secant iteration on partial steps. Requires: numbers.h, event_velocity, the kernel event_functions, EVENTS,
 * EVENT_DEGREE, EVENTS_USE_VELOCITIES; EVENT_NODES, the nodes as fractions of a part of a step; EVENT_COEFFICIENTS,
 * from values there to coefficients of x^k, -1 <= x <= 1; EVENT_DOUBTS, the factors of the last two coefficients in the
 * error estimate. */
enum {
  EVENT_SPLITS = 6, /* greatest depth of subdivision of a step */
  EVENT_TRIALS = 200, /* largest number of states evaluated for one crossing; bisection takes 52 */
  EVENT_BISECTIONS = 30, /* for the abscissa of an extremum: an error of 2^-30 changes the extremum by 2^-60 */
  EVENT_FIRST_PROBE = 40, /* after a start at a zero, the first state tested is 2^-40 of a step later */
  EVENT_LAST_PROBE = 4,
  EVENT_NO_ROOM = -1
};

#define EVENT_TIE 0x1p-30 /* relative to the step: closer crossings may coincide */
#define EVENT_AT_ZERO (16.0 * DBL_EPSILON) /* relative to the range of a function on a step: residual of a located
                                            * zero */
#define EVENT_UNCHANGED (4.0 * DBL_EPSILON) /* relative to the range of a function on a step: a change that may be
                                           * rounding */
#define EVENT_SMALL_PART 0.03 /* a polynomial whose error estimate is less than this part of its range is accepted */
#define EVENT_STEEPNESS 8.0 /* a zero is simple if the derivative exceeds so many error estimates */

typedef NAME(watch) event_watch;
typedef NAME(crossing) event_crossing;

#ifndef EVENT_GUARDS
#define EVENT_GUARDS 0 /* values of the kernel event_guards: conditions of crossings, each of the function GUARDED */
#endif

/* Kernels of events; EVENT_MAPS + e: changes by function e. */
enum {
  EVENT_FUNCTIONS,
  EVENT_CONDITIONS,
  EVENT_MAPS
};

/* Values of a kernel of events at a state; in index notation they are computed by the caller. */
static int event_kernel(int kernel, real t, const real *q, const real *p, const real *parameters, real *value,
    real *workspace)
{
#ifdef EVENTS_OF_ANY_SIZE
  (void)workspace;
  return event_host->evaluate(kernel, t, q, p, parameters, value);
#else
  real u[3 * M];
  int status = OK;
  memcpy(u, q, sizeof(real) * M);
  memcpy(u + M, p, sizeof(real) * M);
  memset(u + 2 * M, 0, sizeof(real) * M);
  if (EVENTS_USE_VELOCITIES)
    status = event_velocity(t, q, p, parameters, u + 2 * M, workspace);
  if (status != OK)
    return status;
  if (kernel == EVENT_FUNCTIONS)
    event_functions(u, t, parameters, value);
#if EVENT_GUARDS > 0
  else if (kernel == EVENT_CONDITIONS)
    event_guards(u, t, parameters, value);
#endif
#ifdef EVENT_CHANGES
  else
    event_changes(u, t, parameters, value);
#endif
  return OK;
#endif
}

int NAME(event_values)(real t, const real *q, const real *p, const real *parameters, real *value, real *workspace)
{
  const int status = event_kernel(EVENT_FUNCTIONS, t, q, p, parameters, value, workspace);
  if (status != OK)
    return status;
  return all_finite(value, EVENTS) ? OK : NOT_FINITE;
}

/* Event functions at a fraction of a step, and the state there, in memory that later samples may use as well. */
typedef struct {
  real fraction, t, g[EVENTS], *q, *p;
} event_sample;

#ifdef EVENTS_OF_ANY_SIZE
#define EVENT_MEMORY(watch, name, size)                    \
  real *const name = (event_host = (watch)->host)->memory; \
  (watch)->used = 0;
#else
#define EVENT_MEMORY(watch, name, size) real name[size];
#endif

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
  real *memory; /* state of the last sample (2 M), work (5 M); states, values and work of changes */
} event_step;

static void copy_state(real *q, real *p, const real *q0, const real *p0)
{
  memcpy(q, q0, sizeof(real) * M);
  memcpy(p, p0, sizeof(real) * M);
}

/* Evaluates the functions at the state of a sample; watch->undefined is 1 + the index of the first that is not
 * finite. */
static int evaluate_functions(const event_step *step, event_sample *sample)
{
  const int status = NAME(event_values)(sample->t, sample->q, sample->p, step->parameters, sample->g, step->workspace);
  if (status == NOT_FINITE)
    for (int e = EVENTS - 1; e >= 0; e--)
      if (!all_finite(sample->g + e, 1))
        step->watch->undefined = e + 1;
  return status;
}

/* Computes the sample at a fraction of the step by one step of that size. */
static int take_sample(const event_step *step, real fraction, event_sample *sample)
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
  return status == OK ? evaluate_functions(step, sample) : status;
}

static int changes_sign(real from, real to)
{
  return (from < 0.0 && to >= 0.0) || (from > 0.0 && to <= 0.0);
}

/* sum_k c[k] x^k */
static real polynomial(const real *c, int degree, real x)
{
  real sum = c[degree];
  for (int k = degree - 1; k >= 0; k--)
    sum = sum * x + c[k];
  return sum;
}

/* Zeros of c in -1 < x < 1, ascending; at most one between neighbouring extrema. Returns their number. */
static int polynomial_crossings(const real *c, int degree, real *x)
{
  real derivative[EVENT_DEGREE + 1] = {0.0}, ends[EVENT_DEGREE + 2];
  int count = 0, parts = 1;
  if (degree < 1)
    return 0;
  for (int k = 1; k <= degree; k++)
    derivative[k - 1] = k * c[k];
  ends[0] = -1.0;
  parts += polynomial_crossings(derivative, degree - 1, ends + 1);
  ends[parts] = 1.0;
  for (int i = 0; i < parts; i++) {
    real low = ends[i], high = ends[i + 1];
    const real start = polynomial(c, degree, low);
    if (!changes_sign(start, polynomial(c, degree, high)))
      continue;
    for (int k = 0; k < EVENT_BISECTIONS; k++) {
      const real middle = 0.5 * (low + high);
      if (changes_sign(start, polynomial(c, degree, middle)))
        high = middle;
      else
        low = middle;
    }
    x[count++] = 0.5 * (low + high);
  }
  return count;
}

/* Coefficients of the interpolating polynomial, its error estimate `doubt` from the last two Chebyshev coefficients,
 * and the range of its deviation from the value in the middle. */
static void interpolate(const real *g, real *c, real *doubt, real *range)
{
  *range = 0.0;
  for (int k = 0; k <= EVENT_DEGREE; k++) {
    c[k] = 0.0;
    for (int j = 0; j <= EVENT_DEGREE; j++)
      c[k] += EVENT_COEFFICIENTS[k][j] * g[j];
    *range += k > 0 ? fabs(c[k]) : 0.0;
  }
  *doubt = EVENT_DOUBTS[0] * fabs(c[EVENT_DEGREE - 1]) + EVENT_DOUBTS[1] * fabs(c[EVENT_DEGREE]);
}

static real nearer_middle(real a, real b)
{
  return fabs(a) < fabs(b) ? a : b;
}

/* Abscissa, nearest to the middle, where the sign of the polynomial c or the simplicity of a zero is uncertain, or 2 if
 * there is none; also returns the extrema, ascending. */
static real uncertain_abscissa(const real *c, real doubt, real *extrema, int *count)
{
  real derivative[EVENT_DEGREE], zeros[EVENT_DEGREE], place = 2.0;
  const int zero_count = polynomial_crossings(c, EVENT_DEGREE, zeros);
  for (int k = 1; k <= EVENT_DEGREE; k++)
    derivative[k - 1] = k * c[k];
  *count = polynomial_crossings(derivative, EVENT_DEGREE - 1, extrema);
  for (int i = 0; i < zero_count; i++)
    if (fabs(polynomial(derivative, EVENT_DEGREE - 1, zeros[i])) <= EVENT_STEEPNESS * doubt)
      place = nearer_middle(zeros[i], place);
  for (int i = 0; i < *count; i++)
    if (fabs(polynomial(c, EVENT_DEGREE, extrema[i])) <= doubt)
      place = nearer_middle(extrema[i], place);
  return place;
}

/* Narrows a sign change to neighbouring fractions; high is the later end. After a secant step the end that it moved is
 * advanced by steps of doubling size until the sign changes. */
static int enclose_crossing(const event_step *step, int e, event_sample low, event_sample *high)
{
  const real least = 2.0 * DBL_EPSILON;
  real moved = 0.0;
  int beyond = 0; /* 1: low is advanced, -1: high is */
  for (int k = 0; k < EVENT_TRIALS && high->g[e] != 0.0 && high->fraction - low.fraction > 2.0 * least; k++) {
    const real width = high->fraction - low.fraction, leap = fmin(2.0 * moved, 0.5 * width);
    real fraction = low.fraction + low.g[e] / (low.g[e] - high->g[e]) * width;
    event_sample now;
    int status;
    if (beyond)
      fraction = beyond > 0 ? low.fraction + leap : high->fraction - leap;
    fraction = fmin(fmax(fraction, low.fraction + least), high->fraction - least);
    status = take_sample(step, fraction, &now);
    if (status != OK)
      return status;
    if (changes_sign(low.g[e], now.g[e])) {
      moved = high->fraction - fraction;
      beyond = beyond > 0 ? 0 : -1;
      *high = now;
    } else {
      moved = fraction - low.fraction;
      beyond = beyond < 0 ? 0 : 1;
      low = now;
    }
  }
  return OK;
}

/* Adds the crossing between two samples if its direction is requested. */
static int add_crossing(const event_step *step, int e, const event_sample *from, const event_sample *to)
{
  const int direction = from->g[e] < 0.0 ? 1 : -1;
  event_sample at = *to;
  event_crossing *crossing = step->found + *step->filled;
  int status;
  if (step->watch->direction[e] == -direction)
    return OK;
  if (*step->filled == step->room)
    return EVENT_NO_ROOM;
  status = enclose_crossing(step, e, *from, &at);
  if (status == OK && at.q == step->memory)
    status = take_sample(step, at.fraction, &at);
  if (status != OK)
    return status;
#ifdef EVENTS_OF_ANY_SIZE
  if (step->watch->used == step->room)
    return EVENT_NO_ROOM;
  crossing->q = event_host->states + 2 * M * step->watch->used++;
  crossing->p = crossing->q + M;
#endif
  crossing->t = at.t;
  crossing->fraction = at.fraction;
  crossing->function = e;
  crossing->direction = direction;
  copy_state(crossing->q, crossing->p, at.q, at.p);
  ++*step->filled;
  return OK;
}

/* Adds the crossings of one function between two samples, with samples at the extrema between them. */
static int add_crossings(const event_step *step, int e, const event_sample *left, const event_sample *right,
    const real *extrema, int count)
{
  event_sample from = *left, to;
  for (int i = 0; i <= count; i++) {
    int status = OK;
    if (i < count)
      status = take_sample(step, extrema[i], &to);
    else
      to = *right;
    if (status == OK && changes_sign(from.g[e], to.g[e]))
      status = add_crossing(step, e, &from, &to);
    if (status != OK)
      return status;
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
  real g[EVENT_DEGREE + 1], c[EVENT_DEGREE + 1], extrema[EVENT_DEGREE], doubt, range, split, before = left->g[e];
  int count, follows, crossed = 0, status = OK;
  event_sample sample;
  g[0] = left->g[e];
  g[EVENT_DEGREE] = right->g[e];
  for (int j = 1; j < EVENT_DEGREE; j++) {
    if (!known) {
      status = take_sample(step, left->fraction + EVENT_NODES[j] * 2.0 * half, &sample);
      if (status != OK)
        return status;
    }
    g[j] = known ? known[j - 1] : sample.g[e];
  }
  interpolate(g, c, &doubt, &range);
  follows = doubt <= EVENT_SMALL_PART * range;
  if (fabs(c[0]) > range + (follows ? doubt : range))
    return status; /* far from zero */
  split = uncertain_abscissa(c, doubt, extrema, &count);
  if (split < 1.0 || !follows)
    split = split > 1.0 ? 0.0 : fmin(fmax(split, -0.5), 0.5);
  for (int i = 0; i <= count; i++) {
    const real value = i < count ? polynomial(c, EVENT_DEGREE, extrema[i]) : g[EVENT_DEGREE];
    crossed |= changes_sign(before, value);
    before = value;
    if (i < count)
      extrema[i] = middle + half * extrema[i];
  }
  if (split > 1.0 || splits == 0)
    return crossed || split < 1.0 ? add_crossings(step, e, left, right, extrema, count) : status;
  status = take_sample(step, middle + half * split, &sample);
  if (status == OK)
    status = search_part(step, e, left, &sample, NULL, splits - 1);
  return status == OK ? search_part(step, e, &sample, right, NULL, splits - 1) : status;
}

/* Change of a function if each coordinate changes by one ulp: the effect of rounding of the state. In index notation
 * the largest change if all coordinates change at once, with alternating signs of three patterns. */
static int rounding_of(const event_step *step, int e, const event_sample *at, real *noise)
{
  event_sample next = *at;
  next.q = step->memory + 2 * M;
  *noise = 0.0;
#ifdef EVENTS_OF_ANY_SIZE
  for (int pattern = 0; pattern < 3; pattern++) {
    int status;
    for (int i = 0; i < M; i++)
      next.q[i] = at->q[i] * (1.0 + ((i * pattern / 2) % 2 ? -DBL_EPSILON : DBL_EPSILON));
    status = evaluate_functions(step, &next);
    if (status != OK)
      return status;
    *noise = fmax(*noise, fabs(next.g[e] - at->g[e]));
  }
#else
  memcpy(next.q, at->q, sizeof(real) * M);
  for (int i = 0; i < M; i++) {
    int status;
    next.q[i] *= 1.0 + DBL_EPSILON;
    status = evaluate_functions(step, &next);
    if (status != OK)
      return status;
    *noise += fabs(next.g[e] - at->g[e]);
    next.q[i] = at->q[i];
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
    int status;
    ends[side].q = step->memory;
    ends[side].p = step->memory + M;
    for (int i = 0; i < M; i++) {
      ends[side].q[i] = at->q[i] + (dq ? part * dq[i] : 0.0);
      ends[side].p[i] = at->p[i] + (dp ? part * dp[i] : 0.0);
    }
    ends[side].t += part * dt;
    status = evaluate_functions(step, ends + side);
    if (status != OK)
      return status;
  }
  *found = (ends[1].g[e] - ends[0].g[e]) / (2.0 * size);
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
  int status = event_velocity(at->t, at->q, at->p, step->parameters, v, step->workspace);
  if (status == OK)
    status = take_sample(step, little, &next);
  if (status != OK)
    return status;
  for (int i = 0; i < M; i++) {
    dq[i] = v[i] * (next.t - at->t) / little;
    dp[i] = (next.p[i] - at->p[i]) / little;
    fast = fmax(fast, fabs(dq[i]));
    large = fmax(large, fabs(at->q[i]));
  }
  size = fast > 0.0 && 0x1p-17 * large / fast > little ? 0x1p-17 * large / fast : little;
  status = difference(step, e, at, dq, NULL, 0.0, size, &by_q);
  if (status == OK)
    status = difference(step, e, at, NULL, dp, (next.t - at->t) / little, little, &by_rest);
  *change = by_q + by_rest;
  *doubt = noise / size + (by_rest != 0.0 ? noise / little : 0.0);
  return status;
}

/* Start of the search in a first step. A run that ended at a zero and restarts there, e.g. after a rebound, may be on
 * the near side of the zero by a rounding error, or exactly on it; if it leaves to the other side and returns within
 * the step, the signs at both ends do not reveal the crossing. States after the start, each four times as far as the
 * previous one, are tested until one is beyond rounding, then until the function returns. If it returns before the
 * first of these states, crossings accumulate (Zeno) and NOT_CONVERGED is returned. */
static int leave_zero(const event_step *step, int e, const event_sample *left, real range, event_sample *from)
{
  event_sample next;
  real noise, change, doubt;
  int sign, place = EVENT_FIRST_PROBE, away = 0, status = rounding_of(step, e, left, &noise);
  if (status == OK && fabs(left->g[e]) > EVENT_AT_ZERO * range + 8.0 * noise)
    return OK;
  if (status == OK)
    status = first_change(step, e, left, noise, &change, &doubt);
  if (status != OK) {
    step->watch->undefined = 0; /* the rate is not defined at this state */
    return OK;
  }
  sign = change > 0.0 ? 1 : -1;
  if (fabs(change) <= EVENT_UNCHANGED * range + 4.0 * doubt || sign * left->g[e] > 0.0)
    return OK;
  for (; place >= EVENT_LAST_PROBE; place -= 2) {
    status = take_sample(step, ldexp(1.0, -place), &next);
    if (status != OK)
      return status;
    if (!away && fabs(next.g[e]) <= 8.0 * noise + 4.0 * fabs(left->g[e]))
      continue;
    if (!away && sign * next.g[e] < 0.0 && (step->watch->remaining[e] > 0 || step->watch->acts[e]) &&
        step->watch->direction[e] != sign) {
      step->watch->accumulated = e + 1;
      return NOT_CONVERGED;
    }
    away = 1;
    if (changes_sign(from->g[e], next.g[e]))
      status = add_crossing(step, e, from, &next);
    if (status != OK)
      return status;
    *from = next;
  }
  return OK;
}

/* Finds the crossings of all functions on a step, in no particular order. */
static int search_step(const event_step *step, const event_sample *left, const event_sample *right)
{
  real inner[EVENTS][EVENT_DEGREE - 1];
  for (int j = 1; j < EVENT_DEGREE; j++) {
    event_sample sample;
    const int status = take_sample(step, EVENT_NODES[j], &sample);
    if (status != OK)
      return status;
    for (int e = 0; e < EVENTS; e++)
      inner[e][j - 1] = sample.g[e];
  }
  for (int e = 0; e < EVENTS; e++) {
    event_sample from = *left;
    int status = OK;
    if (!step->watch->started) {
      real range = fabs(right->g[e] - left->g[e]);
      for (int j = 1; j < EVENT_DEGREE; j++)
        range = fmax(range, fabs(inner[e][j - 1] - left->g[e]));
      status = leave_zero(step, e, left, range, &from);
    }
    if (status == OK)
      status = search_part(step, e, &from, right, from.fraction > 0.0 ? NULL : inner[e], EVENT_SPLITS);
    if (status != OK)
      return status;
  }
  return OK;
}

/* Counts a crossing; returns 1 if it ends the search, or changes the state. */
static int ends_search(event_watch *watch, const event_crossing *crossing)
{
  int *remaining = watch->remaining + crossing->function;
  watch->ended |= *remaining > 0 && --*remaining == 0;
  return watch->ended || watch->acts[crossing->function];
}

/* Sets *open to 1 if the conditions of a function are satisfied at a state, all g >= 0, else to 0. */
static int check_guards(const event_step *step, int e, real t, const real *q, const real *p, int *open)
{
  int status = OK;
  *open = 1;
#if EVENT_GUARDS > 0
  real value[EVENT_GUARDS];
  status = event_kernel(EVENT_CONDITIONS, t, q, p, step->parameters, value, step->workspace);
  if (status != OK)
    return status;
  for (int i = 0; i < EVENT_GUARDS; i++)
    *open &= GUARDED[i] != e || value[i] >= 0.0;
#else
  (void)step, (void)e, (void)t, (void)q, (void)p;
#endif
  return status;
}

/* After the crossing that ends the search, keeps those of other functions that have already changed sign at its state:
 * a search from there would not find them. */
static int keep_coincident(const event_step *step, long long last)
{
  const long long filled = *step->filled;
  const event_crossing end = step->found[last];
  event_sample at = {.t = end.t, .q = step->memory, .p = step->memory + M};
  int status;
  copy_state(at.q, at.p, end.q, end.p);
  status = evaluate_functions(step, &at);
  *step->filled = last + 1;
  for (long long i = last + 1; status == OK && i < filled; i++) {
    const event_crossing other = step->found[i];
    if (other.fraction - end.fraction > EVENT_TIE || (real)other.direction * at.g[other.function] < 0.0)
      continue;
    ends_search(step->watch, &other);
    step->found[*step->filled] = end;
    step->found[*step->filled].function = other.function;
    step->found[*step->filled].direction = other.direction;
    ++*step->filled;
  }
  return status;
}

/* Sorts the crossings of one step by their fractions, as times may coincide, and drops those whose conditions are not
 * satisfied and those after the one that ends the search or changes the state. */
static int settle_crossings(const event_step *step, long long first)
{
  long long kept = first;
  for (long long i = first + 1; i < *step->filled; i++)
    for (long long k = i; k > first && step->found[k].fraction < step->found[k - 1].fraction; k--) {
      const event_crossing later = step->found[k - 1];
      step->found[k - 1] = step->found[k];
      step->found[k] = later;
    }
  for (long long i = first; i < *step->filled; i++) {
    const event_crossing *now = step->found + i;
    int open, status = check_guards(step, now->function, now->t, now->q, now->p, &open);
    if (status != OK)
      return status;
    if (open)
      step->found[kept++] = *now;
  }
  *step->filled = kept;
  for (long long i = first; i < *step->filled; i++)
    if (ends_search(step->watch, step->found + i))
      return keep_coincident(step, i);
  return OK;
}

int NAME(crossings)(event_watch *watch, long long count, const real *h, const real *t, const real *q,
    const real *p, const real *parameters, const solver_options *options, long long room,
    event_crossing *found, long long *filled, solver_report *report, real *workspace)
{
  EVENT_MEMORY(watch, memory, 7 * M)
  event_sample left, right;
  memset(report, 0, sizeof *report);
  *filled = 0;
  for (long long k = 0; k < count && !watch->ended; k++) {
    const long long start = k > 0 ? k - 1 : 0, first = *filled;
    const event_step step = {t[start], h[start], h[start], q + start * M, p + start * M, parameters, options, watch,
        found, room, filled, report, workspace, memory};
    int status;
    report->t = t[start];
    right.fraction = k > 0 ? 1.0 : 0.0;
    right.t = t[k];
    right.q = (real *)(q + k * M); /* not changed */
    right.p = (real *)(p + k * M);
    status = evaluate_functions(&step, &right);
    if (status == OK && k > 0) {
      left.fraction = 0.0;
      status = search_step(&step, &left, &right);
    }
    if (status != OK) {
      *filled = first;
      return status == EVENT_NO_ROOM ? OK : status;
    }
    status = settle_crossings(&step, first);
    if (status != OK)
      return status;
    watch->started |= k > 0;
    report->steps = k;
    left = right;
  }
  return OK;
}

#endif
