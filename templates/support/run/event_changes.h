#include "events.h"
#include "impacts.h"
#include "kinks.h"
#ifdef EVENT_CONTACTS
#include "contacts.h"
#endif

/* Runs whose events change the state: impacts, impulses, switches.
 *
 * A step is searched for crossings, advanced to the first that changes the state by a partial step, changed, and
 * continued from there: fixed steps to the end of the step, adaptive ones by a new step. Requires: impacts.h,
 * IS_CONDITIONAL, EVENTS_CONTROLLED. */
enum {
  CHANGES_IN_STEP = 100000, /* largest number of changes of the state in a step, and of impacts in a corner */
  CHANGE_CREEPS = 64, /* largest number of successive adaptive steps in which time hardly advances */
  CHANGES_IN_WINDOW = 1000, /* number of changes whose time is compared with the mean time between changes */
  CHANGE_GAPS = 8 /* intervals between hits from which their accumulation is estimated */
};

#define CHANGE_APPROACH 8.0 /* roundings of a rate that is no approach: gaps stay within CHANGE_SAFETY for 8 impacts */
#define CHANGE_RATIO 1e-3 /* relative spread of the ratios of intervals that accumulate */
#define CHANGE_PACE 1e-3 /* least time of so many changes, relative to that mean */
#define CHANGE_REST 1e-8 /* relative to the time since the first of them: remaining time at which a contact closes */
#define CHANGE_LOOSER 16.0 /* ratio of the tolerances of steps that do not meet that of a run, by rounding of gaps */
#define CHANGE_LOOSEST 0.01 /* beyond which none is tried */
#define CHANGE_SHORT 0x1p-10 /* steps relative to the pace below which rounding may change momenta */
#define CHANGE_COUPLED 1e3 /* ratio of its effects with all gaps and with each alone, of rows that nearly depend */
#define CHANGE_NOISE 64.0 /* largest part of the momenta that rounding changes in such a step, relative to it */
#define CHANGE_CAUSE 1e-6 /* the least: below it the error has another cause, as a collision */
#define CHANGE_GAIN 1e3 /* part of the energy of motion by which a step may create some, relative to the tolerance .. */
#define CHANGE_MOST 1e-2 /* .. and the largest one: by steps from rest, of 173 tolerances */
#define CHANGE_FAIR 1e-9 /* least tolerance of energies: rounding of gaps changes them by 1e-11 in the shortest steps */
#define CHANGE_END 1e-6 /* relative to a step: remaining time at which an accumulation ends the run */

/* Records the interval since the last hit. If the last intervals decrease geometrically and the remaining ones are
 * negligible, crossings accumulate: the search ends and watch->end is the sum of the series. */
static void note_hit(const event_step *step, event_crossing *crossing, real t)
{
  event_watch *watch = step->watch;
  NAME(event_history) *const history = watch->history + FUNCTION_OF(crossing);
  real *gaps = history->gaps, low = INFINITY, high = 0.0, ratio = 0.0, last;
  crossing->before = *history;
  crossing->acted = 1;
  memmove(gaps, gaps + 1, sizeof(real) * (CHANGE_GAPS - 1));
  last = gaps[CHANGE_GAPS - 1] = fabs(watch->time - history->last);
  history->last = watch->time;
#ifdef EVENT_CONTACTS
  history->since = history->hits > 0 ? history->since : watch->time;
#endif
  history->hits += history->hits <= CHANGE_GAPS;
  for (int k = 1; k < CHANGE_GAPS; k++) {
    ratio = gaps[k] / gaps[k - 1];
    low = fmin(low, ratio);
    high = fmax(high, ratio);
  }
  watch->end = t + (step->h < 0.0 ? -1.0 : 1.0) * (ratio < 1.0 ? last * ratio / (1.0 - ratio) : 0.0);
  if (history->hits <= CHANGE_GAPS || high >= 1.0 ||
      !(high - low <= CHANGE_RATIO * ratio + 50.0 * DBL_EPSILON * fabs(t) / last + history->rounding / last))
    return; /* also where some are 0 */
  watch->changes -= watch->changes % CHANGES_IN_WINDOW; /* a geometric series ends */
  watch->window = watch->time;
#ifdef EVENT_CONTACTS
  if (is_transition(crossing->function)) { /* slips that stop and begin accumulate with impacts of other contacts */
    const int *const transition = TRANSITION[crossing->function - FIRST_TRANSITION];
    const int rests = last * ratio / (1.0 - ratio) < CHANGE_REST * fabs(watch->time - history->since);
    if (transition[1] == CONTACT_CLOSES) {
      watch->accumulates[transition[0]] = rests;
      history->hits *= !rests;
    }
    return;
  }
#endif
  if (last * ratio / (1.0 - ratio) < CHANGE_END * fabs(step->whole)) {
    watch->accumulated = crossing->function + 1;
    watch->ended = 1;
  }
}

/* Fails if the last changes of the state are much faster than those since the start, and than the step. */
static int check_pace(const event_step *step, int event)
{
  event_watch *watch = step->watch;
  const real elapsed = fmax(fabs(watch->time), fabs(step->whole)), window = fabs(watch->time - watch->window);
  watch->recent[event]++;
  if (++watch->changes % CHANGES_IN_WINDOW)
    return OK;
  if (window * (real)watch->changes < CHANGE_PACE * elapsed) {
    watch->chatters = event + 1;
    return NOT_CONVERGED;
  }
  watch->window = watch->time;
  memset(watch->recent, 0, sizeof watch->recent);
  return OK;
}

/* Rate of change of function e along the step at a state, in the direction of the run. */
static int rate_along(const event_step *step, int e, const event_sample *at, real *rate)
{
  const real part = 0x1p-20 * step->h;
  event_sample next = {.t = at->t + part, .q = step->memory, .p = step->memory + M};
  solver_report own;
  TRY(NAME(step)(at->t, part, at->q, at->p, step->parameters, step->options, next.q, next.p, &own,
      step->workspace));
  TRY(evaluate_function(step, e, &next));
  *rate = (next.g - at->g) / fabs(part);
  return OK;
}

/* State of the crossings from `first` on. That of an impact is moved back along the flow by g / (dg/dt), at most the
 * resolution of a fraction of the step, so that large steps do not enter walls by many roundings; that of a kink either
 * way, since a force that jumps adds energy in each step that passes it. */
static int refine_crossing(const event_step *step, long long first, const event_sample *right, event_sample *at,
    real *part)
{
  event_crossing *crossing = step->found + first;
  event_entries wall;
  solver_report own;
  real back = 0.0, least, *const q = step->memory, *const p = q + M;
  (void)right;
  at->t = crossing->t;
  copy_state(at->q, at->p, crossing->q, crossing->p);
#ifdef EVENT_CONSTRAINTS /* momenta of constrained steps of the size of rounding are ill-conditioned: interpolated */
  const real short_part = fmax(EVENT_TIE * fabs(step->whole), 4.0 * DBL_EPSILON * fabs(step->t));
  for (int k = 0; k < M && fabs(*part) < short_part; k++)
    at->p[k] = step->p[k] + *part / step->h * (right->p[k] - step->p[k]);
  for (long long i = first; i < *step->filled; i++)
    copy_state(step->found[i].q, step->found[i].p, at->q, at->p);
  return evaluate_function(step, FUNCTION_OF(crossing), at);
#endif
  TRY(evaluate_function(step, FUNCTION_OF(crossing), at));
  if (!(IS_IMPACT[crossing->function] || is_kink(crossing->function)))
    return OK;
  if (is_kink(crossing->function))
    TRY(rate_along(step, FUNCTION_OF(crossing), at, &wall.rate));
  else
    TRY(changes_at(step, FUNCTION_OF(crossing), at, &wall));
  back = fmin(at->g / wall.rate, fabs(*part)); /* in the direction of the run, at most to the start */
  least = is_kink(crossing->function) ? -CHANGE_SAFETY * DBL_EPSILON * fabs(step->h) : 0.0;
  if (!(back > least && back <= CHANGE_SAFETY * DBL_EPSILON * fabs(step->h)))
    return OK;
  back = step->h < 0.0 ? -back : back;
  TRY(NAME(step)(at->t, -back, at->q, at->p, step->parameters, step->options, q, p, &own, step->workspace));
  at->t -= back;
  *part -= back;
  copy_state(at->q, at->p, q, p);
  for (long long i = first; i < *step->filled; i++) {
    step->found[i].t = at->t;
    copy_state(step->found[i].q, step->found[i].p, at->q, at->p);
  }
  return OK;
}

/* Whether function e may be within rounding of zero at the state of a change, by bounds 2^20 times as large: of the
 * effect of rounding, and of its change along the step. Saves the gradients of most of many functions. */
static int may_be_touched(const event_step *step, int e)
{
  const real value = values_at(step, EVENT_DEGREE + 1)[e];
  real range = 0.0;
  if (EVENTS <= EVENT_FEW)
    return 1;
  for (int j = 0; j <= EVENT_DEGREE; j++)
    range = fmax(range, fabs(values_at(step, j)[e] - value));
  return fabs(value) <= 0x1p-20 * range + 0x1p26 * values_at(step, EVENT_DEGREE + 2)[e];
}

/* Notes the rounding of a function at its zero: that of its change in the step. */
static int note_rounding(const event_step *step, int e, event_sample *at)
{
  const real change = fmax(fabs(values_at(step, 0)[e]), fabs(values_at(step, EVENT_DEGREE)[e]));
  TRY(evaluate_function(step, e, at));
  step->watch->history[e].slack = fmax(fabs(at->g), EVENT_AT_ZERO * change);
  return OK;
}

/* Whether the zeros of an event end a mode, and do not change the state themselves. */
static int ends_mode(int event)
{
  return is_transition(event) || is_kink(event);
}

/* Adds a wall that a state touches and approaches where those from `first` on are crossed, or at a start. */
static int add_met(const event_step *step, int e, long long first, const event_sample *at)
{
  event_crossing *crossing = step->found + *step->filled;
  const event_crossing *const others = *step->filled > first ? step->found + first : NULL;
  if (*step->filled == step->room || !place_crossing(step->watch, crossing, step->room))
    return EVENT_NO_ROOM;
  crossing->t = at->t;
  crossing->fraction = others ? others->fraction : 0.0;
  crossing->function = EVENT_OF(e);
  crossing->element = e - EVENT_FIRST[EVENT_OF(e)];
  crossing->direction = -1;
  copy_state(crossing->q, crossing->p, others ? others->q : at->q, others ? others->p : at->p);
#ifdef EVENT_MODES
  memcpy(crossing->mode, step->watch->mode, BYTES(EVENT_MODES));
#endif
  ends_search(step->watch, crossing);
  ++*step->filled;
  return OK;
}

/* Changes the state at the crossings from `first` on, which have one state, then at all walls that it touches within
 * rounding and approaches, in their order, until there is none; walls that are met there are crossings, too. */
static int change_at_crossings(const event_step *step, long long first, event_sample *at)
{
  int met = 1, impacts = 0;
  const long long last = *step->filled;
  const real *const value = values_at(step, EVENT_DEGREE + 1);
  real rate, *const v = step->memory + 3 * M;
  for (long long i = first; i < last; i++)
    if (step->watch->acts[step->found[i].function]) {
#ifdef EVENT_MODES
      memcpy(step->found[i].mode, step->watch->mode, BYTES(EVENT_MODES));
#endif
      const int event = step->found[i].function, e = FUNCTION_OF(step->found + i);
      const int status = ends_mode(event) ? note_rounding(step, e, at) : change_state(step, e, at);
      note_hit(step, step->found + i, at->t);
      TRY(status);
      TRY(check_pace(step, event));
    }
  while (met > 0) {
    met = 0;
    TRY(evaluate_functions(step, at, values_at(step, EVENT_DEGREE + 1)));
    if (ANY_IMPACTS)
      TRY(approach(step, at, NULL, 0.0, v, &rate));
    for (int e = 0; e < EVENTS; e++) {
      const int event = EVENT_OF(e);
      event_entries wall;
      int open = 0, known = 0;
      if (!IS_IMPACT[event] || !step->watch->acts[event] || (first < last && !may_be_touched(step, e)))
        continue;
      TRY(evaluate_changes(step, e, at, v, &wall));
      if (fabs(value[e]) <= wall.slack && wall.rate < -CHANGE_APPROACH * DBL_EPSILON * wall.size)
        TRY(conditions(e, at->t, at->q, at->p, step->parameters, &open, step->workspace));
      if (!open)
        continue;
      met = 1;
      if (impacts++ == CHANGES_IN_STEP) {
        step->watch->jammed = event + 1;
        return NOT_CONVERGED;
      }
      for (long long i = first; i < *step->filled; i++)
        known |= FUNCTION_OF(step->found + i) == e;
      if (!known)
        TRY(add_met(step, e, first, at));
      TRY(change_state(step, e, at));
      if (!known)
        note_hit(step, step->found + *step->filled - 1, at->t);
      TRY(approach(step, at, NULL, 0.0, v, &rate));
    }
  }
  return OK;
}

/* Fails if a step that began before a wall ends behind it without a crossing: contact that persists. Without `left`,
 * fails if the start `right` of a run is behind a wall that has no conditions: a wall of finite size may be passed. */
static int check_walls(const event_step *step, const event_sample *left, const event_sample *right)
{
  const real *const before = values_at(step, 0), *const after = values_at(step, left ? EVENT_DEGREE : 0);
  real rate, *const v = step->memory + 3 * M;
  int known = 0;
  for (int e = 0; e < EVENTS; e++) {
    const int event = EVENT_OF(e);
    event_entries wall;
    int open = left || !IS_CONDITIONAL[event];
    if (after[e] >= 0.0 || !IS_IMPACT[event] || !step->watch->acts[event])
      continue;
    if (!known)
      TRY(approach(step, left ? left : right, NULL, 0.0, v, &rate));
    known = 1;
    TRY(evaluate_changes(step, e, left ? left : right, v, &wall));
    if (left)
      TRY(conditions(e, right->t, right->q, right->p, step->parameters, &open, step->workspace));
    wall.slack = fmax(wall.slack, step->watch->history[e].slack); /* the velocity after an impact may be 0 */
    if (open && (!left || before[e] >= -wall.slack) && after[e] < -wall.slack) {
      step->watch->through = event + 1;
      step->watch->behind = left ? 0.0 : after[e];
      return NOT_CONVERGED;
    }
  }
  return OK;
}

/* Impacts at the start of a run, with walls that its state touches and approaches; *changes: whether there are any. */
static int change_at_start(const event_step *step, event_sample *at, int *changes)
{
  const long long first = *step->filled;
  *changes = 0;
  TRY(check_walls(step, NULL, at));
  TRY(change_at_crossings(step, first, at));
  *changes = *step->filled > first;
#ifdef EVENT_CONTACTS
  if (*changes)
    TRY(change_contacts(step, first, at));
#endif
  return OK;
}

/* State after a part of a step. */
static int step_from_left(const event_step *step, const event_sample *left, real part, event_sample *right)
{
  solver_report own;
  return NAME(step)(left->t, part, left->q, left->p, step->parameters, step->options, right->q, right->p, &own,
      step->workspace);
}

#ifdef EVENT_KINKS
/* Sides of kinks after other changes, at zeros those after a small part of a step, which the next step keeps. */
static int renew_sides(const event_step *step, long long first, const event_sample *at)
{
  const real part = ldexp(step->whole, -KINK_LAST_PROBE);
  event_sample next = {.t = at->t + part, .q = step->memory, .p = step->memory + M};
  int changed = 0;
  for (long long i = first; i < *step->filled; i++)
    changed |= step->watch->acts[step->found[i].function] && !is_kink(step->found[i].function);
  if (!changed)
    return OK;
  TRY(values_of_kinks(step, at, values_at(step, 0)));
  TRY(step_from_left(step, at, part, &next));
  TRY(values_of_kinks(step, &next, values_at(step, 1)));
  for (int k = 0; k < EVENT_KINKS; k++) {
    const int e = EVENT_FIRST[FIRST_KINK + k];
    const real g = values_at(step, 0)[e], change = values_at(step, 1)[e] - g;
    const int is_zero = fabs(g) <= KINK_ZERO * fabs(change);
    if (IS_OF_TIME(k) || IS_WALL(FIRST_KINK + k) || (g == 0.0 && change == 0.0))
      continue;
    set_side(step, k, (is_zero ? change : g) > 0.0 ? 1 : -1);
    if (is_zero)
      step->watch->history[e] = (NAME(event_history)){.last = step->watch->time, .slack = fabs(g), .hits = 1};
  }
  return OK;
}
#endif

/* Cuts a part of a fixed step to `longest`, and to one that resolves slips in space; the first was taken by the run
 * unless it is replaced, in its state, too, in other modes. */
static int shorten_part(const event_step *step, event_sample *left, event_sample *right, event_run *run, int changes,
    real longest, real *part)
{
  const real whole = *part;
  int is_taken = changes == 0;
  longest = fmin(longest, fabs(whole));
#ifdef EVENT_CONTACTS
  real taken[EVENT_MODES];
  for (int k = 0; k < EVENT_MODES; k++)
    taken[k] = step->own[MODE_PLACE[k]];
  put_modes(step->watch->mode, step->own);
#ifdef CONTACTS_IN_SPACE
  real by_slips = longest;
  TRY(renew_slips(step, left, &by_slips));
  longest = fmin(longest, by_slips);
#endif
  for (int k = 0; k < EVENT_MODES; k++)
    is_taken &= taken[k] == step->watch->mode[k];
#endif
  if (longest < fabs(whole))
    *part = copysign(longest, whole);
  if (*part == whole && is_taken)
    return OK;
  TRY(evaluate_functions(step, left, values_at(step, 0)));
  TRY(step_from_left(step, left, *part, right));
  right->t = *part == whole ? run->t : left->t + *part;
  if (*part == whole)
    set_run(run, run->t, right);
  return OK;
}

#ifdef EVENT_CONTACTS
/* Whether the stage equations of a part of a step were not solved, of which those of its half may be: of slow slips and
 * nearly straight legs. */
static int may_be_halved(const event_step *step, int status, real part, real pace)
{
  const event_watch *const watch = step->watch;
  const int unsolved = status == NOT_CONVERGED || status == SINGULAR || status == STATUS(SPURIOUS_SOLUTION);
  return unsolved && 0.5 * fabs(part) > CONTACT_UNSOLVED * pace &&
      !(watch->refusal || watch->accumulated || watch->through || watch->chatters || watch->jammed);
}
#endif

#if defined(CONTACTS_VARY) && EVENTS_CONTROLLED
/* Compares changes of the speeds of slips whose friction varies, in a part of an adaptive step up to `at`, with moments
 * of their rates, integral of s' dt = s(T) - s(0) and of t/T s' dt = s(T) - mean of s, by a quadrature of more points
 * than those of the part, and both ends: stages do not see the friction of slow slips just before a stop. One moment
 * may be right by chance. Errors are relative to what friction takes of the slip in the part, so that those of all
 * parts amount to friction that is off by the tolerance; in space to the fastest slip so far: near a stop its direction
 * turns like a power of the time that is left, which no part resolves. Rounding is that of forces that cancel, and of
 * the speed by the momenta of all bodies, at which iterations of a step end. */
static int judge_slips(const event_step *step, const event_sample *left, const event_sample *at, real part,
    real tolerance)
{
  const real least = CHANGE_SAFETY * DBL_EPSILON;
  real missed[EVENT_CONTACTS][2] = {{0.0}}, taken[EVENT_CONTACTS] = {0.0}, rounding[EVENT_CONTACTS] = {0.0};
  real force[CONTACT_ROWS], second[CONTACT_ROWS];
  int exact = 1;
  contact_mode mode[EVENT_CONTACTS];
  contact_terms of;
  for (int j = 0; j < CONTACT_KNOTS; j++) {
    event_sample knot = {.t = left->t + CONTACT_KNOT[j] * part, .q = step->memory, .p = step->memory + M};
    const int starts = j == 0, ends = j == CONTACT_KNOTS - 1;
    if (!starts && !ends)
      TRY(step_from_left(step, left, CONTACT_KNOT[j] * part, &knot));
    TRY(terms_at(step, starts ? left : ends ? at
                                            : &knot,
        &of));
    modes_at(&of, step->watch->mode, mode);
    exact &= solve_contacts(&of, mode, of.second, force, second, NULL) <= CONTACT_OUTSIDE;
    for (int k = 0; k < EVENT_CONTACTS; k++) {
      const int first = CONTACTS[k].tangential, is_judged = CONTACTS[k].varies && mode[k].closed && !mode[k].sticks;
      const real speed = is_judged ? length_of(of.rate + first, CONTACTS[k].slips) : 0.0;
      real rate = 0.0;
      for (int i = 0; is_judged && i < CONTACTS[k].slips; i++) {
        rate += (speed > 0.0 ? of.rate[first + i] / speed : mode[k].direction[i]) * second[first + i];
        rounding[k] = fmax(rounding[k], least * fmax(of.second_terms[first + i] * fabs(part), of.speed[first + i]));
      }
      missed[k][0] += CONTACT_WEIGHT[j] * part * rate + (starts - ends) * speed;
      missed[k][1] += CONTACT_WEIGHT[j] * (CONTACT_KNOT[j] * part * rate + speed) - ends * speed;
      if (is_judged)
        taken[k] += CONTACT_WEIGHT[j] * fabs(part) * length_of(force + first, CONTACTS[k].slips) *
            of.W[first * (CONTACT_ROWS + 1)];
    }
  }
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const real size = CONTACTS[k].slips > 1 ? step->watch->fastest[k] : taken[k];
    for (int i = 0; i < 2; i++)
      exact &= fabs(missed[k][i]) <= tolerance * size + rounding[k];
  }
  return exact || 0.5 * fabs(part) <= CONTACT_UNSOLVED * step->watch->pace ? OK : NOT_CONVERGED;
}
#endif

/* Error of a part of a fixed step up to `at`: the difference from its two halves, without rounding, of positions and of
 * velocities in the length of the step, relative to the motion in it and to the largest one in a step so far, which it
 * enlarges: rebounds may leave none. A short part in a stiff wall may change the velocity of all that follows. Fails if
 * a half is not solved. */
static int error_of_part(const event_step *step, const event_sample *left, const event_sample *at, real part,
    real *largest_motion, real *error)
{
  const real duration = fabs(step->whole);
  real *const v = step->memory + 2 * M, *const v_at = v + M, far = 0.0, fast = DBL_MIN;
  event_sample middle = {.t = left->t + 0.5 * part, .q = v, .p = v_at};
  event_sample end = {.q = step->memory, .p = step->memory + M};
  *error = 0.0;
  TRY(step_from_left(step, left, 0.5 * part, &middle));
  TRY(step_from_left(step, &middle, 0.5 * part, &end));
  TRY(NAME(velocity)(at->t, at->q, at->p, step->parameters, v_at, step->workspace));
  TRY(NAME(velocity)(at->t, end.q, end.p, step->parameters, v, step->workspace));
  for (int i = 0; i < M; i++) {
    far = fmax(far, fabs(at->q[i]));
    fast = fmax(fast, fmax(fabs(v[i]), fabs(v_at[i])));
  }
  const real rounding = CHANGE_SAFETY * DBL_EPSILON * far * (1.0 + duration / fabs(part));
  const real largest = *largest_motion = fmax(duration * fast, *largest_motion);
  for (int i = 0; i < M; i++) {
    const real apart = fabs(end.q[i] - at->q[i]) + duration * fabs(v[i] - v_at[i]);
    *error = fmax(*error, (apart - rounding) / (duration * fmax(fabs(v[i]), fabs(v_at[i])) + largest));
  }
  return OK;
}

/* Lets the error of a run contain that of a part of a fixed step which a change bounds, in units of the motion that it
 * enlarges; NaN, an unknown error, if a half is not solved: it judges the part, which is. */
static void judge_part(event_run *run, const event_step *step, const event_sample *left, const event_sample *at,
    real part)
{
  const event_run unit = {.error = 2.0};
  const real before = NAME(step_error)(run), motion = run->largest_motion;
  real error;
  if (!(before >= 0.0 && before < INFINITY)) /* the method has no estimate, or the error is unknown */
    return;
  if (error_of_part(step, left, at, part, &run->largest_motion, &error) != OK)
    error = NAN;
  if (motion > 0.0)
    run->error *= motion / run->largest_motion;
  if (!(error <= NAME(step_error)(run))) {
    run->error = pow(error, 1.0 / log2(NAME(step_error)(&unit))); /* of which step_error is a power */
    run->error_t = left->t;
  }
}

/* Sets the state of a run after a change: of an adaptive step, or of the last part of a fixed one. */
static void end_at_change(event_run *run, const event_run *before, const event_sample *at, int ends, int adaptive)
{
  if (!ends) {
    copy_run(run, before);
    run->step += adaptive;
    run->t_low = 0.0;
  }
  set_run(run, at->t, at);
#if defined(EVENT_MODES) && EVENTS_CONTROLLED
  if (adaptive) { /* the next step is found and compared as the first one */
    run->error_before = 0.0;
    run->steps_to_compare = 1;
  }
#endif
}

/* Crossings of a part of a step up to a state. */
static int search_crossings(const event_step *step, const event_sample *left, const event_sample *right)
{
  TRY(evaluate_functions(step, right, values_at(step, EVENT_DEGREE)));
#ifdef EVENT_KINKS
  if (kinks_are_far(step, left, right))
    return OK;
#endif
  TRY(search_step(step, left, right));
#ifdef EVENT_KINKS
  note_rates(step);
#endif
  return OK;
}

/* Searches of a part of a fixed step: the first one, a second one up to twice the first change behind kinks, and that
 * whose first change stands, since the second found none: it is of the size of rounding. */
enum { FIRST_SEARCH,
  SECOND_SEARCH,
  FOUND_ALONE };

#ifdef EVENT_KINKS
/* Twice the time to the first of the crossings from `first` on that changes the state, if it is before the first inner
 * node of the search: behind kinks, in stiff walls, others before it may have been missed. INFINITY otherwise. */
static real resolved_part(const event_step *step, long long first, int *search)
{
  real fraction = INFINITY;
  for (long long i = first; i < *step->filled; i++)
    if (step->watch->acts[step->found[i].function])
      fraction = fmin(fraction, step->found[i].fraction);
  const real part = fabs(step->h) * fraction;
  if (*search == SECOND_SEARCH && fraction == INFINITY) {
    *search = FOUND_ALONE;
    return fabs(step->whole);
  }
  if (*search == FOUND_ALONE || !(fraction < EVENT_NODES[1] && part > EVENT_TIE * fabs(step->whole)))
    return INFINITY;
  *search = SECOND_SEARCH;
  return 2.0 * part;
}
#endif

/* Changes a state at the crossings from `first` on: by impacts, then sides of kinks and modes of contacts. */
static int change_at(const event_step *step, long long first, event_sample *at)
{
  TRY(change_at_crossings(step, first, at));
#ifdef EVENT_KINKS
  TRY(change_sides(step, first, at));
#endif
#ifdef EVENT_CONTACTS
  TRY(change_contacts(step, first, at));
#endif
#ifdef EVENT_KINKS
  TRY(renew_sides(step, first, at));
#endif
  return OK;
}

/* Fails if a step ends behind a wall, on another side of a kink, or in a gap, without a crossing. */
static int check_end(const event_step *step, const event_sample *left, const event_sample *right)
{
  TRY(check_walls(step, left, right));
#ifdef EVENT_KINKS
  TRY(check_sides(step, right));
#endif
#ifdef EVENT_CONTACTS
  TRY(check_gaps(step, right));
#endif
  return OK;
}

/* First of the crossings from `first` on that have the state of the last one, at which a part of a step ends. */
static long long last_state(const event_step *step, long long first)
{
  while (step->found[first].fraction != step->found[*step->filled - 1].fraction)
    first++;
  return first;
}

/* Whether a part of a fixed step is taken again, of which crossings from `first` on were found: up to `longest`, where
 * others before them may have been missed or its stage equations were not solved; or whole without a contact that
 * others nearly hold. */
static int takes_again(const event_step *step, event_sample *left, int status, real part, long long first, int *search,
    real *longest, int *again)
{
  *longest = INFINITY;
#ifdef EVENT_KINKS
  *longest = status == OK ? resolved_part(step, first, search) : INFINITY;
#endif
  *again = *longest < INFINITY;
#ifdef EVENT_CONTACTS
  if (!*again && may_be_halved(step, status, part, 0.0)) {
    *step->filled = first;
    *again = 0.5 * fabs(part) > CONTACT_UNSOLVED * fabs(step->whole);
    if (!*again)
      return open_nearly_held(step, left, again);
    *longest = 0.5 * fabs(part);
  }
#endif
  if (*again)
    *step->filled = first;
  (void)left, (void)part, (void)search;
  return OK;
}

/* Finds the crossings of a part of a step, those from `first` on, up to its end `right`. */
static int settle_part(const event_step *step, long long first, const event_sample *right)
{
#ifdef EVENT_CONTACTS
  TRY(end_modes_at_start(step, right));
#endif
  (void)right;
  return settle_crossings(step, first);
}

/* Fails if errors of a part up to `at` are too large; notes those of parts of a fixed step that changes bound. */
static int judge_end(const event_step *step, event_run *run, const event_sample *left, const event_sample *at,
    real part, const step_control *control, int is_bounded)
{
#if defined(CONTACTS_VARY) && EVENTS_CONTROLLED
  if (control)
    TRY(judge_slips(step, left, at, part, control->tolerance));
#endif
  if (!control && is_bounded)
    judge_part(run, step, left, at, part);
  return OK;
}

/* Changes the state at the start of a run; *starts: whether there are changes, *ends: whether the step ends with
 * them. */
static int change_start(const event_run *before, event_run *run, event_step *step, int adaptive,
    const stored_states *to, event_sample *left, int *starts, int *ends)
{
  *starts = *ends = 0;
  if (before->step == 0 && ANY_IMPACTS)
    TRY(change_at_start(step, left, starts));
  if (!*starts)
    return OK;
  TRY(store_state(to, left, 0.0, 0, adaptive ? before->step + 1 : -1, step->report));
  *ends = adaptive || step->watch->ended;
  if (*ends)
    end_at_change(run, before, left, 0, adaptive);
  return OK;
}

/* Stores the state after a part of a step of which a length is left; *ends: whether the step ends there. */
static int end_part(const event_run *before, event_run *run, event_step *step, int adaptive, real length, real part,
    int iterations, const stored_states *to, event_sample *at, int *ends)
{
  const int is_last = fabs(length) <= CHANGE_SAFETY * DBL_EPSILON * fabs(step->whole);
  const long long within = adaptive ? before->step + 1 : -1;
  at->t = is_last && !step->watch->ended ? run->t : at->t; /* which output times may equal */
  TRY(store_state(to, at, part, is_last ? iterations : 0, is_last ? run->step : within, step->report));
  *ends = is_last || adaptive || step->watch->ended;
  if (*ends)
    end_at_change(run, before, at, is_last, adaptive);
  return OK;
}

/* Searches a step of a run that was at `before`, changes the state at crossings and continues the step: one of an
 * adaptive run with `control`. */
static int change_in_step(const event_run *before, event_run *run, event_step *step, const step_control *control,
    real length, int iterations, const stored_states *to)
{
  const int adaptive = control != NULL;
  int starts, ends, search = FIRST_SEARCH;
  real *const states = step->memory + 9 * M;
  event_sample left = {.t = before->t, .q = states, .p = states + M};
  event_sample right = {.fraction = 1.0, .t = run->t, .q = states + 2 * M, .p = states + 3 * M};
  real longest = INFINITY;
  step->whole = step->h = length;
#ifdef CONTACTS_IN_SPACE
  step->whole = adaptive ? fmax(length, step->watch->pace) : length;
#endif
  copy_state(left.q, left.p, before->q, before->p);
  copy_state(right.q, right.p, run->q, run->p);
  TRY(evaluate_functions(step, &left, values_at(step, 0)));
  TRY(change_start(before, run, step, adaptive, to, &left, &starts, &ends));
  for (int changes = starts; !ends; changes++) {
    event_sample at = {.q = states + 4 * M, .p = states + 5 * M};
    real part = length;
    int acts = 0, again = 0, cut, status = OK;
    if (!adaptive)
      status = shorten_part(step, &left, &right, run, changes, longest, &part);
    cut = part != length;
    const long long first = *step->filled;
    long long group = first;
    step->t = left.t;
    step->h = part;
    step->q = left.q;
    step->p = left.p;
    if (status == OK)
      status = search_crossings(step, &left, &right);
    if (!adaptive)
      TRY(takes_again(step, &left, status, part, first, &search, &longest, &again));
    if (again)
      continue;
    search = FIRST_SEARCH;
    step->rounding_known |= !step->watch->started;
    if (status == OK)
      status = settle_part(step, first, &right);
    if (status == NOT_CONVERGED && step->watch->accumulated) {
      step->watch->ended = 1; /* the start of this part is where crossings accumulate */
      end_at_change(run, before, &left, 0, 0);
      return OK;
    }
    TRY(status);
    for (long long i = first; i < *step->filled; i++)
      acts |= step->watch->acts[step->found[i].function];
    const int stops = acts || step->watch->ended;
    if (stops) {
      group = last_state(step, first);
      part *= step->found[group].fraction;
      TRY(refine_crossing(step, group, &right, &at, &part));
    }
    TRY(judge_end(step, run, &left, stops ? &at : &right, part, control, acts || (changes > 0 && !cut)));
    step->watch->time += part;
    cut &= !stops;
    if (cut) {
      at.t = right.t;
      copy_state(at.q, at.p, right.q, right.p);
    } else if (!stops) {
      step->watch->started = 1;
      if (changes > 0)
        set_run(run, run->t, &right);
      TRY(check_end(step, &left, &right));
      return store_state(to, &right, length, iterations, run->step, step->report);
    }
    if (EVENTS > EVENT_FEW && !step->rounding_known) {
      TRY(rounding_of(step, &left));
      step->rounding_known = 1;
    }
    if (!cut)
      TRY(change_at(step, group, &at));
    length -= part;
    step->watch->started = cut;
    TRY(end_part(before, run, step, adaptive, length, part, iterations, to, &at, &ends));
    if (ends)
      return OK;
    if (changes == CHANGES_IN_STEP) {
      step->watch->jammed = step->found[group].function + 1;
      return NOT_CONVERGED;
    }
    left.t = at.t;
    copy_state(left.q, left.p, at.q, at.p);
  }
  return OK;
}

#ifdef EVENT_CONTACTS
/* First modes of contacts at a state. Gaps are measured by the least time T in which a row r changes by its size or
 * its rate, |r| = |r''| T^2 and |r'| = |r''| T, in any units, above the rounding of the times of the run, as its own
 * states at rest have rows of that size; by a duration if there is none. */
static int begin_at(event_step *step, event_sample *at, real duration)
{
  const real rounding = CONTACT_LOWEST * DBL_EPSILON * (fabs(at->t) + fabs(duration));
  contact_terms of;
  real least = INFINITY;
  step->whole = 0.0;
  TRY(terms_at(step, at, &of));
  for (int r = 0; r < CONTACT_ROWS; r++) {
    const real second = fabs(of.second[r]), time = sqrt(of.size[r] / second) + of.speed[r] / second;
    least = time > rounding ? fmin(least, time) : least;
  }
  step->whole = step->h = isinf(least) ? duration : copysign(least, duration);
  return begin_contacts(step, at);
}
#endif

#ifdef EVENT_MODES
/* First modes of a run, those of contacts by its state. */
static int begin_run(event_run *run, event_step *step, real duration)
{
  int status = OK;
  for (int k = 0; k < EVENT_MODES; k++)
    step->watch->mode[k] = step->own[MODE_PLACE[k]];
#ifdef EVENT_CONTACTS
  event_sample at = {.t = run->t, .q = step->memory + 9 * M, .p = step->memory + 10 * M};
  copy_state(at.q, at.p, run->q, run->p);
  status = begin_at(step, &at, duration);
  if (status == OK && (memcmp(at.q, run->q, BYTES(M)) != 0 || memcmp(at.p, run->p, BYTES(M)) != 0))
    set_run(run, run->t, &at);
#endif
  (void)run, (void)duration;
  step->watch->begun = status == OK;
  return status;
}
#endif
#ifdef EVENT_CONTACTS

int NAME(begin_contacts)(event_watch *watch, real t, real *q, real *p, const real *parameters, real *workspace)
{
  EVENT_MEMORY(watch, memory, 15 * M + CHANGE_VALUES)
  real own[PARAMETERS];
  event_sample at = {.t = t, .q = q, .p = p}, horizon = {.q = memory + 7 * M, .p = memory + 8 * M};
  solver_report report = {0};
  event_step step = {t, 0.0, 0.0, q, p, own, NULL, watch, NULL, 0, NULL, &report, workspace, memory, memory + 15 * M, 0,
      &horizon, own};
  memcpy(own, parameters, BYTES(PARAMETERS));
  for (int k = 0; k < EVENT_MODES; k++)
    watch->mode[k] = own[MODE_PLACE[k]];
  return begin_at(&step, &at, watch->pace);
}
#endif

/* One step of a run: adaptive, or without `control` of its h. */
static int advance_run(event_run *run, real t_end, const step_control *control, const event_step *step, int *iterations,
    solver_report *own)
{
  int status = NOT_CONVERGED;
  real t, *const q = step->memory, *const p = q + M;
  if (!control)
    status = NAME(advance)(run, 1, 1, step->parameters, step->options, &t, q, p, iterations, own, step->workspace);
#if EVENTS_CONTROLLED
  else
    status = NAME(advance_to)(run, t_end, control, 1, 1, step->parameters, step->options, &t, q, p, iterations, own,
        step->workspace);
#endif
  (void)t_end;
  return status;
}

/* One step of a run, shorter if it would pass t_end; returns its size in *length. */
static int take_step(event_run *run, real t_end, const step_control *control, const event_step *step, real *length,
    int *iterations)
{
  const real start = run->t, left = (t_end - run->t) - run->t_low;
  event_sample end = {.q = step->memory, .p = step->memory + M};
  solver_report own;
  int status;
#if defined(EVENT_POWERS) && EVENTS_CONTROLLED
  step_control shorter;
  control = control ? graded(step, control, &shorter) : control;
#endif
  if (control || fabs(left) >= (1.0 - CHANGE_WHOLE) * fabs(run->h)) {
    status = advance_run(run, t_end, control, step, iterations, &own);
    *length = control ? run->t - start : run->h;
  } else {
    *length = left;
    status = NAME(step)(run->t, left, run->q, run->p, step->parameters, step->options, end.q, end.p, &own,
        step->workspace);
    *iterations = (int)own.iterations;
    if (status == OK)
      set_run(run, t_end, &end);
    run->t_low = 0.0;
    run->step++;
  }
  step->report->t = start;
  step->report->change = own.change;
  step->report->iterations += own.iterations;
  return status;
}

#if defined(EVENT_CONTACTS) && EVENTS_CONTROLLED
/* Part of the momenta by which rounding changes them in a step of h. Gaps have errors u r_k, which move positions by
 * X_k u r_k, X = M^-1 G^T W^-1, sqrt((W^-1)_kk) u r_k in the kinetic metric of the motion h sqrt(p v): where W is
 * nearly singular, as on nearly straight legs, the more the shorter it is. *apart: of each gap as the only one. */
static int part_by_rounding(const event_step *step, event_run *run, real h, real *part, real *apart)
{
  const event_sample at = {.t = run->t, .q = run->q, .p = run->p};
  contact_terms of;
  contact_mode mode[EVENT_CONTACTS];
  real force[CONTACT_ROWS], after[CONTACT_ROWS], square = 0.0, alone = 0.0, power = DBL_MIN;
  TRY(terms_at(step, &at, &of)); /* and the velocities */
  modes_at(&of, step->watch->mode, mode);
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    real right[CONTACT_ROWS] = {0.0};
    const int row = CONTACTS[k].normal;
    if (row < 0 || !mode[k].closed)
      continue;
    right[row] = of.rounding[row];
    solve_contacts(&of, mode, right, force, after, NULL);
    square += of.rounding[row] * fabs(force[row]);
    alone += of.rounding[row] * of.rounding[row] / of.W[row * (CONTACT_ROWS + 1)];
  }
  for (int i = 0; i < M; i++)
    power += at.p[i] * step->memory[3 * M + i];
  *part = sqrt(square / power) / h;
  *apart = sqrt(alone / power) / h;
  return OK;
}

/* Whether a step is so short that rounding changes its momenta by more than the tolerance, as rows nearly depend on
 * each other. */
static int is_rounded(const event_step *step, event_run *before, real size, real tolerance, int *rounded)
{
  real part, apart;
  *rounded = size == 0.0;
  if (*rounded || fabs(size) >= CHANGE_SHORT * step->watch->pace)
    return OK;
  TRY(part_by_rounding(step, before, fabs(size), &part, &apart));
  *rounded = part > CHANGE_NOISE * tolerance && part > CHANGE_COUPLED * apart;
  return OK;
}

/* Fails if a step with its changes creates energy, of a system that cannot, by more than parts of the largest p . v and
 * loss in a step so far, since motions end, and of the work of normal forces, in given modes, along the sizes of their
 * gaps, which are rounded: those of their terms and of what they would fall in the step, at rest at the origin, too.
 * Independent of the error estimate: states in a step, in which straight legs fold at once, solve the equations of its
 * parts. */
static int check_energy(const event_step *step, event_run *before, event_run *run, const real *modes, real tolerance)
{
  const event_sample left = {.t = before->t, .q = before->q, .p = before->p};
  contact_terms of;
  contact_mode mode[EVENT_CONTACTS];
  real force[CONTACT_ROWS], after[CONTACT_ROWS], first, last, power = 0.0, allowed, *const v = step->memory + 3 * M;
  if (!ENERGY_DECREASES)
    return OK;
  TRY(NAME(energy)(left.t, left.q, left.p, step->own, &first, step->workspace));
  TRY(NAME(energy)(run->t, run->q, run->p, step->own, &last, step->workspace));
  TRY(NAME(velocity)(run->t, run->q, run->p, step->own, v, step->workspace));
  for (int i = 0; i < M; i++)
    power += run->p[i] * v[i];
  power = step->watch->vigour = fmax(step->watch->vigour, fmax(power, first - last));
  allowed = fmin(CHANGE_GAIN * tolerance, CHANGE_MOST) * power + CONTACT_LOWEST * DBL_EPSILON * fabs(first);
  step->watch->gain = 0.0; /* later failures have other causes */
  if (last - first <= allowed)
    return OK;
  TRY(terms_at(step, &left, &of));
  modes_at(&of, modes, mode);
  solve_contacts(&of, mode, of.second, force, after, NULL);
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const int row = CONTACTS[k].normal;
    const real size = row < 0 ? 0.0 : fmax(of.size[row], of.speed[row] * fabs(step->whole));
    allowed += row < 0 ? 0.0 : tolerance * fabs(force[row]) * size;
  }
  step->watch->gain = last - first > allowed ? last - first : 0.0;
  return step->watch->gain > 0.0 ? NOT_CONVERGED : OK;
}

/* Takes an adaptive step where none meets the tolerance since gaps of closed contacts are rounded, whose part of the
 * error grows as steps get shorter: with the least larger tolerance that one of any size so far meets, its equations
 * solved as those of fixed steps. The next step has a half of that tolerance, then a quarter .. */
static int take_rounded_step(event_run *run, event_run *before, real t_end, const step_control *control,
    const event_step *step, real *size, int *iterations)
{
  event_watch *const watch = step->watch;
  const solver_options fixed = step->options ? *step->options : NAME(default_options)();
  event_step exact = *step;
  step_control loose = *control;
  real part, apart;
  int status = STATUS(STEP_SIZE_UNDERFLOW);
  exact.options = &fixed;
  loose.max_step = fmin(loose.max_step, watch->pace > 0.0 ? watch->pace / CONTACT_PACE : t_end - before->t);
  loose.first_step = &loose.max_step;
  loose.tolerance = fmax(loose.tolerance, DBL_EPSILON);
  TRY(part_by_rounding(step, before, loose.max_step, &part, &apart));
  while ((status != OK || part > CHANGE_NOISE * loose.tolerance) && loose.tolerance < CHANGE_LOOSEST) {
    loose.tolerance *= CHANGE_LOOSER;
    copy_run(run, before);
    run->error_before = 0.0;
    run->steps_to_compare = 1;
    status = take_step(run, t_end, &loose, &exact, size, iterations);
    if (status == OK)
      TRY(part_by_rounding(step, before, *size, &part, &apart));
  }
  watch->rounded = fmax(watch->rounded, part);
  if (status != OK || part > CHANGE_NOISE * loose.tolerance || part < CHANGE_CAUSE * loose.tolerance)
    return STATUS(STEP_SIZE_UNDERFLOW);
  watch->tolerance = loose.tolerance;
  watch->missed = fmax(watch->missed, loose.tolerance);
  return OK;
}
#endif

#ifdef EVENT_CONTACTS
/* One step of a run with contacts, if its start is settled with status OK: a fixed one that is longer than slips allow,
 * or not solved, with open contacts, since its parts follow. */
static int take_contact_step(int status, event_run *run, event_run *before, real t_end, const step_control *control,
    const event_step *step, real longest, real *size, int *iterations)
{
  if (status == OK && (control || longest >= fabs(run->h)))
    status = take_step(run, t_end, control, step, size, iterations);
  else if (status == OK)
    status = NOT_CONVERGED;
#if EVENTS_CONTROLLED
  int rounded = 0;
  if (status == OK && control && run->t != t_end)
    status = is_rounded(step, before, *size, control->tolerance, &rounded);
  if (status == STATUS(STEP_SIZE_UNDERFLOW) || rounded)
    status = take_rounded_step(run, before, t_end, control, step, size, iterations);
#endif
  if (status == OK && control)
    step->watch->pace = fmax(step->watch->pace, CONTACT_PACE * *size);
#ifdef CONTACTS_IN_SPACE
  step->watch->is_cut = *size * exp2(0.25) >= longest; /* by a level of sizes */
#endif
  if (step->watch->begun && !control && may_be_halved(step, status, run->h, 0.0)) { /* by parts: only time advances */
    put_in_all(CONTACT_IS_OPEN, step->own);
    copy_run(run, before);
    status = take_step(run, t_end, control, step, size, iterations);
  }
  return status;
}
#endif

#if defined(EVENT_CONTACTS) && EVENTS_CONTROLLED
/* Opens a contact that others nearly hold, if time hardly advances by adaptive steps, or none is taken: as where no
 * part of a fixed step is solved. Not twice at a time. */
static int open_where_creeps(int status, event_run *run, const event_run *before, event_step *step, real *opened,
    int *opens)
{
  event_watch *const watch = step->watch;
  watch->creeps = run->t - before->t < CONTACT_UNSOLVED * watch->pace ? watch->creeps + 1 : 0;
  if (*opened == before->t ||
      !(status == OK ? watch->creeps > CHANGE_CREEPS : status == STATUS(STEP_SIZE_UNDERFLOW)))
    return status;
  if (status != OK)
    copy_run(run, before);
  event_sample at = {.t = *opened = before->t, .q = run->q, .p = run->p};
  step->whole = watch->pace / CONTACT_PACE;
  run->error_before = 0.0;
  const int changed = open_nearly_held(step, &at, opens);
  return changed == OK && !*opens ? status : changed;
}
#endif

#ifdef EVENT_KINKS
/* Sides of kinks at the start of a step, by a trial of it where they are unknown, and its length to the first of the
 * powers that it enters. */
static int begin_at_kinks(event_run *run, event_run *before, event_step *step, real t_end, const step_control *control,
    real *size)
{
  const event_sample start = {.t = run->t, .q = before->q, .p = before->p};
  int unknown = 0, count;
  step->h = control ? t_end - run->t : run->h; /* whose direction counts */
  int status = settle_sides(step, &start, &unknown), tried = unknown;
#if defined(EVENT_POWERS) && EVENTS_CONTROLLED
  tried |= control && enters_power(step);
  step->watch->first = INFINITY;
#endif
  if (status == OK && tried && control)
    status = take_step(run, t_end, control, step, size, &count);
  if (status == OK && unknown)
    status = sides_after_start(step, &start, *size);
  if (tried)
    copy_run(run, before);
  if (status != OK && unknown) {
    *size = control ? INFINITY : run->h;
    status = sides_at_jump(step, &start, step->h);
  }
#ifdef EVENT_POWERS
  step->watch->first = tried ? fabs(*size) : INFINITY;
#endif
  return status;
}
#endif

/* Undoes the changes of a step that is taken again, which are the crossings from `first` on. */
static void undo_changes(const event_step *step, const event_watch *before, long long first)
{
  for (long long i = *step->filled - 1; i >= first; i--)
    if (step->found[i].acted)
      step->watch->history[FUNCTION_OF(step->found + i)] = step->found[i].before;
  *step->watch = *before;
  *step->filled = first;
}

#if defined(EVENT_CONTACTS) && EVENTS_CONTROLLED
/* Control of a step of at most some size, whose tolerance returns to that of the run after one that missed it. */
static const step_control *limit_step(event_watch *watch, const step_control *control, real most, step_control *limited)
{
  *limited = *control;
  limited->max_step = fmin(control->max_step, most);
  watch->tolerance *= watch->tolerance > DBL_EPSILON ? 0.5 : 0.0;
  limited->tolerance = fmax(control->tolerance, watch->tolerance);
  return limited;
}
#endif

/* Begins a step: first modes of a run, slips in space, which allow a *longest step, and sides of kinks. */
static int begin_step(event_run *run, event_run *before, event_step *step, real t_end, const step_control *control,
    real *longest, real *size)
{
  int status = OK;
#ifdef CONTACTS_IN_SPACE
  event_watch *const watch = step->watch;
  event_sample now = {.t = run->t, .q = run->q, .p = run->p};
  *longest = fabs(run->h);
#if EVENTS_CONTROLLED
  const real unknown_size = watch->pace > 0.0 ? watch->pace : fabs(t_end - run->t);
  if (control) /* the size that the controller has found */
    *longest = run->error_before > 0 ? exp2((real)run->grid_level / 4.0) : unknown_size;
#endif
  step->whole = fmax(*longest, watch->pace);
#endif
#ifdef EVENT_MODES
  if (!step->watch->begun)
    status = begin_run(run, step, control ? t_end - run->t : run->h);
  put_modes(step->watch->mode, step->own);
#endif
#ifdef CONTACTS_IN_SPACE
  if (status == OK)
    status = renew_slips(step, &now, longest);
#endif
  keep_run(before, run, step->values + (long long)EVENT_VALUES * EVENTS);
#ifdef EVENT_KINKS
  *size = run->h;
  if (status == OK)
    status = begin_at_kinks(run, before, step, t_end, control, size);
#endif
  (void)t_end, (void)control, (void)longest, (void)size;
  return status;
}

/* Returns to the start of a step that failed. Whether it is taken again, as an adaptive one of that size was not
 * solved; if not, *status becomes OK where no crossing has room. */
static int returns_to(const event_step *step, event_run *run, const event_run *before, const event_watch *watched,
    long long crossed, real size, int *status)
{
  int again = 0;
#ifdef EVENT_CONTACTS
  again = may_be_halved(step, *status, size, step->watch->pace);
  if (step->watch->gain > 0.0 && !again)
    refuse(step, CONTACT_CREATES_ENERGY, -1, step->watch->gain);
#endif
  (void)size;
  copy_run(run, before);
  if (again || *status == EVENT_NO_ROOM) {
    undo_changes(step, watched, crossed);
    *status = OK;
  } else {
    *step->filled = crossed;
  }
  return again;
}

int NAME(advance_with_changes)(event_run *run, event_watch *watch, real t_end, const step_control *control,
    long long steps, const real *parameters, const solver_options *options, long long states, real *t, real *q, real *p,
    real *length, int *iterations, long long *number, long long room, event_crossing *found, long long *filled,
    solver_report *report, real *workspace)
{
  EVENT_MEMORY(watch, memory, 15 * M + CHANGE_VALUES)
#ifdef EVENT_MODES
  real own[PARAMETERS];
  memcpy(own, parameters, BYTES(PARAMETERS));
  if (watch->begun)
    put_modes(watch->mode, own);
  parameters = own;
#else
  real *const own = NULL;
#endif
  event_sample horizon = {.q = memory + 7 * M, .p = memory + 8 * M};
  const event_watch initial = *watch;
  const stored_states to = {states, number, t, q, p, length, iterations};
  int status = OK;
#if defined(EVENT_CONTACTS) && EVENTS_CONTROLLED
  real opened = NAN; /* time at which a contact was opened that others nearly hold */
  real unsolved = INFINITY; /* largest size of an adaptive step after one whose parts were not solved */
#endif
  memset(report, 0, sizeof *report);
  *filled = 0;
  while (report->steps < steps && !watch->ended && (t_end - run->t) - run->t_low != 0.0) {
    event_run before;
    const event_watch watched = *watch;
    const long long kept = report->stored, crossed = *filled;
    event_step step = {0.0, 0.0, 0.0, NULL, NULL, parameters, options, watch, found, room, filled, report, workspace,
        memory, memory + 15 * M, 0, &horizon, own};
    real size = 0.0;
    int count = 0;
    real longest = INFINITY;
    status = begin_step(run, &before, &step, t_end, control, &longest, &size);
    const step_control *limited = control;
#ifdef EVENT_CONTACTS
#if EVENTS_CONTROLLED
    step_control shorter;
    limited = control ? limit_step(watch, control, fmin(longest, unsolved), &shorter) : NULL;
    unsolved = INFINITY;
#endif
    status = take_contact_step(status, run, &before, t_end, limited, &step, longest, &size, &count);
#else
    if (status == OK)
      status = take_step(run, t_end, control, &step, &size, &count);
#endif
    if (status == OK)
      status = change_in_step(&before, run, &step, limited, size, count, &to);
#if defined(EVENT_CONTACTS) && EVENTS_CONTROLLED
    if (status == OK && control)
      status = check_energy(&step, &before, run, watched.begun ? watched.mode : watch->mode,
          fmax(control->tolerance, CHANGE_FAIR));
    int opens = 0;
    if (control)
      status = open_where_creeps(status, run, &before, &step, &opened, &opens);
    if (status == OK && opens)
      continue;
#endif
    if (status != OK) {
      report->stored = kept;
#if defined(EVENT_CONTACTS) && EVENTS_CONTROLLED
      unsolved = 0.5 * size;
#endif
      if (returns_to(&step, run, &before, &watched, crossed, control ? size : 0.0, &status))
        continue;
      if (status > STATUS(SPURIOUS_SOLUTION))
        *watch = initial; /* the call is repeated */
      return status;
    }
    report->steps++;
  }
  return OK;
}
