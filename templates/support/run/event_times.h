/* Zero crossings of functions of time alone, independently of the states and of the sizes of steps.
 *
 * Such a function is sampled a sixteenth of a turn of its sines, cosines and rint apart, so that no two zeros of one of
 * these with an affine argument are between two samples, and 64 times a step at least unless it is affine; a change of
 * its sign is bisected to neighbouring times. At the ends of a step the sign is that of eight roundings later: a zero
 * at the end of a step belongs to that step, also if its function has the former sign there by rounding. Requires:
 * numbers.h, IS_TIMED, turn_rate and time_value of parts/event_functions.c.jinja. */
enum {
  EVENT_TIMES = 64, /* samples of a step at least */
  EVENT_MOST_TIMES = 1 << 20, /* and at most */
  EVENT_AFFINE = 2 /* value of IS_TIMED */
};

#define EVENT_TURN 0.0625 /* between two samples */
#define EVENT_SAME_TIME (8.0 * DBL_EPSILON) /* relative to the time: rounding of a zero */

/* Time of the sample after t. */
static int next_time(const event_step *step, int e, real t, real end, real span, real *next)
{
  const real least = fmax(fabs(span) / EVENT_MOST_TIMES, 2.0 * EVENT_SAME_TIME * fabs(t));
  real size = fabs(IS_TIMED[EVENT_OF(e)] == EVENT_AFFINE ? span : span / EVENT_TIMES), rate;
  int status = turn_rate(e, t, step->parameters, &rate, step->workspace);
  size = size * rate > EVENT_TURN ? EVENT_TURN / rate : size;
  for (; status == OK; size *= 0.5) {
    status = turn_rate(e, t + copysign(size, span), step->parameters, &rate, step->workspace);
    if (!(size > least && size * rate > EVENT_TURN))
      break;
  }
  *next = t + copysign(fmax(size, least), span);
  *next = fabs(*next - t) < fabs(end - t) ? *next : end;
  return status;
}

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
  int status = OK;
  for (;;) {
    const real middle = from.t + 0.5 * (high.t - from.t);
    real g;
    if (middle == from.t || middle == high.t)
      break;
    status = time_value(e, middle, step->parameters, &g, step->workspace);
    if (status != OK)
      return status;
    if (changes_sign(from.g, g))
      high.t = middle, high.g = g;
    else
      from.t = middle, from.g = g;
  }
  if (fabs(from.g) < fabs(high.g) && from.t != left->t)
    high.t = from.t, high.g = from.g;
  high.fraction = high.t == right->t ? 1.0 : (high.t - step->t) / step->h;
  from.fraction = high.fraction - 2.0 * DBL_EPSILON; /* enclosed */
  high.q = high.t == right->t ? right->q : high.fraction > 2.0 * DBL_EPSILON ? step->memory
                                                                             : left->q;
  high.p = high.t == right->t ? right->p : high.fraction > 2.0 * DBL_EPSILON ? step->memory + M
                                                                             : left->p;
  status = add_crossing(step, e, &from, &high, NAN);
  if (status == OK && *step->filled > before) {
    step->found[before].t = high.t;
    if (step->watch->acts[EVENT_OF(e)])
      step->horizon->t = high.t;
  }
  return status;
}

/* Finds the crossings of a function of time alone on a step. */
static int search_times(const event_step *step, int e, const event_sample *left, const event_sample *right)
{
  const real span = right->t - left->t;
  event_sample from = *left, to = *right;
  int status = end_value(step, e, left->t, span, &from.g);
  if (JUST_CHANGED(step->watch, e) && side_at_start(step->watch, e) != 0.0) /* whose sign may be that of rounding */
    from.g = copysign(fmax(fabs(from.g), DBL_MIN), side_at_start(step->watch, e));
  while (status == OK && from.t != right->t && (from.t - step->t) / step->h < step->horizon->fraction) {
    status = next_time(step, e, from.t, right->t, span, &to.t);
    if (status == OK && to.t == right->t)
      status = end_value(step, e, to.t, span, &to.g);
    else if (status == OK)
      status = time_value(e, to.t, step->parameters, &to.g, step->workspace);
    if (status == OK && changes_sign(from.g, to.g))
      status = add_time(step, e, from, &to, left, right);
    from.t = to.t, from.g = to.g;
  }
  return status;
}
