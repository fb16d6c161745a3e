/* Zero crossings of functions of time alone, independently of the states and of the sizes of steps.
 *
 * Intervals are excluded by a bound of the change of the function from their middles, or halved until it is monotone
 * (R. E. Moore, Interval Analysis, 1966); a change of its sign is bisected to neighbouring times. Zeros closer than
 * EVENT_SAME_TIME are one. At the ends of a step the sign is that of eight roundings later: a zero at the end of a step
 * belongs to that step, also if its function has the former sign there by rounding. Requires: numbers.h, IS_TIMED,
 * time_reach and time_value of parts/event_functions.c.jinja. */
#define EVENT_INTERVALS (1 << 20) /* largest number of a step */
#define EVENT_TIME_NOISE (8.0 * DBL_EPSILON) /* of a function, for each ulp of its terms */

/* Value of function e at the end t of a step in the direction of `span`. */
static int end_value(const event_step *step, int e, real t, real span, real *g)
{
  return time_value(e, t + copysign(EVENT_SAME_TIME * fabs(t), span), step->parameters, g, step->workspace);
}

/* Adds the crossing between two times. */
static int add_time(const event_step *step, int e, event_sample from, const event_sample *to, const event_sample *left,
    const event_sample *right)
{
  const long long before = *step->filled;
  event_sample high = *to;
  for (;;) {
    const real middle = from.t + 0.5 * (high.t - from.t);
    real g;
    if (middle == from.t || middle == high.t)
      break;
    TRY(time_value(e, middle, step->parameters, &g, step->workspace));
    if (changes_sign(from.g, g))
      high.t = middle, high.g = g;
    else
      from.t = middle, from.g = g;
  }
  TRY(time_value(e, high.t, step->parameters, &high.g, step->workspace)); /* not that behind the end of a step */
  if (fabs(from.g) < fabs(high.g) && from.t != left->t)
    high.t = from.t, high.g = from.g;
  high.fraction = high.t == right->t ? 1.0 : (high.t - step->t) / step->h;
  from.fraction = high.fraction - 2.0 * DBL_EPSILON; /* enclosed */
  high.q = high.t == right->t ? right->q : high.fraction > 2.0 * DBL_EPSILON ? step->memory
                                                                             : left->q;
  high.p = high.t == right->t ? right->p : high.fraction > 2.0 * DBL_EPSILON ? step->memory + M
                                                                             : left->p;
  TRY(add_crossing(step, e, &from, &high, NAN));
  if (*step->filled > before) {
    step->found[before].t = high.t;
    if (step->watch->acts[EVENT_OF(e)])
      step->horizon->t = high.t;
  }
  return OK;
}

/* Adds a crossing if the sign changes between the last state with a sign and a later one. */
static int note_sign(const event_step *step, int e, event_sample *last, const event_sample *to,
    const event_sample *left, const event_sample *right)
{
  const int status = changes_sign(last->g, to->g) ? add_time(step, e, *last, to, left, right) : OK;
  *last = *to;
  return status;
}

/* Finds the crossings from a time to a later state. A function has no sign where it may be that of rounding. */
static int search_until(const event_step *step, int e, real t, const event_sample *to, event_sample *last,
    const event_sample *left, const event_sample *right, int *intervals)
{
  const real half = 0.5 * (to->t - t);
  event_sample middle = {.t = t + half};
  real reach[3];
  if ((t - step->t) / step->h >= step->horizon->fraction)
    return OK;
  TRY(time_value(e, middle.t, step->parameters, &middle.g, step->workspace));
  TRY(time_reach(e, middle.t, fabs(half) + EVENT_SAME_TIME * fabs(to->t), step->parameters, reach, step->workspace));
  const real noise = EVENT_TIME_NOISE * reach[2];
  if (fabs(middle.g) > reach[0])
    return fabs(middle.g) > noise ? note_sign(step, e, last, &middle, left, right) : OK;
  if (reach[1] > 0.0 || 2.0 * fabs(half) <= EVENT_SAME_TIME * fmax(fabs(middle.t), DBL_EPSILON * fabs(step->h)))
    return to->t == right->t || fabs(to->g) > noise ? note_sign(step, e, last, to, left, right) : OK;
  if (fabs(middle.g) + reach[0] <= noise)
    return OK;
  if (--*intervals < 0) {
    step->watch->inseparable = EVENT_OF(e) + 1;
    return NOT_CONVERGED;
  }
  TRY(search_until(step, e, t, &middle, last, left, right, intervals));
  return search_until(step, e, middle.t, to, last, left, right, intervals);
}

/* Finds the crossings of a function of time alone on a step. */
static int search_times(const event_step *step, int e, const event_sample *left, const event_sample *right)
{
  const real span = right->t - left->t;
  event_sample from = *left, to = *right;
  int intervals = EVENT_INTERVALS;
  TRY(end_value(step, e, left->t, span, &from.g));
  if (JUST_CHANGED(step->watch, e) && side_at_start(step->watch, e) != 0.0) /* whose sign may be that of rounding */
    from.g = copysign(fmax(fabs(from.g), DBL_MIN), side_at_start(step->watch, e));
  TRY(end_value(step, e, right->t, span, &to.g));
  return search_until(step, e, left->t, &to, &from, left, right, &intervals);
}
