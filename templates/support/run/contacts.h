#include "contact_impacts.h"
#include "contact_slips.h"

/* Contacts: the modes of a run, which transitions change at their located times.
 *
 * With the rows r of all contacts (gaps g, slips w) the second rates are r'' = b + W f for the forces f of the rows,
 * W = G M^-1 G^T. In a mode forces are unknown at the gaps of closed contacts and at the slips of sticking ones, where
 * r'' = 0; sliding adds -mu d times the normal force at the slip. A mode is consistent if normal forces are >= 0, open
 * contacts have g'' >= 0, sticking ones |tau| <= mu_s lambda, and slip that begins w' d > 0. With friction none
 * (P. Painleve, C. R. Acad. Sci. 121, 1895; F. Genot & B. Brogliato, Eur. J. Mech. A 18, 1999) or several may be.
 * Impacts obey the same conditions for impulses and velocities (C. Glocker, Set-Valued Force Laws, 2001); where forces
 * have none, those of an impact without collision may. Requires: parts/contacts.c.jinja. */
#define CONTACT_START 0x1p-40 /* part of a step after its start at which such a mode ends */
#define CONTACT_NEARLY_HELD 1e-4 /* part of the terms of its second rate, by which a gap accelerates that others hold */
#define CONTACT_MISSED 128.0 /* effects of rounding beyond which a negative gap shows a missed transition */

/* Whether a slip that vanishes along its former direction stops: in space it may pass near 0. */
static int stops_at(const event_step *step, const contact_terms *of, int k)
{
  const real speed = fmax(step->watch->fastest[k], of->speed[CONTACTS[k].tangential]);
  return CONTACTS[k].slips == 1 || length_of(of->rate + CONTACTS[k].tangential, 2) <= CONTACT_SLOW * speed;
}

/* Marks contacts that pull, or whose friction is outside of its cone, in the present modes at a state, by more than a
 * part of the rates. Returns the first; EVENT_CONTACTS if contacts contradict each other, -1: none. */
static int find_outside(const event_step *step, const contact_terms *of, real part, int *outside)
{
  contact_mode mode[EVENT_CONTACTS];
  real force[CONTACT_ROWS], after[CONTACT_ROWS];
  int first;
  modes_at(of, step->watch->mode, mode);
  first = solve_contacts(of, mode, of->second, force, after, NULL) > CONTACT_OUTSIDE ? EVENT_CONTACTS : -1;
  for (int k = EVENT_CONTACTS - 1; k >= 0; k--) {
    const int normal = CONTACTS[k].normal, slip = CONTACTS[k].tangential, slips = CONTACTS[k].slips;
    const int row = normal < 0 ? slip : normal; /* those of open contacts may be undefined */
    const real small = part / CONTACT_ROUNDING * rounding_at_row(of, after, row) / of->W[row * (CONTACT_ROWS + 1)];
    const int pushes = normal < 0 || force[normal] >= -small;
    outside[k] = mode[k].closed &&
        !(pushes && (!mode[k].sticks || length_of(force + slip, slips) <= friction_limit(of, k, 1, force) + small));
    first = outside[k] ? k : first;
  }
  return first;
}

/* Notes that the gaps of open contacts which were closed, or are 0 within rounding, are at a zero of their functions:
 * negative ones, too, as the projection of others moves them, but not those that were negative `before` it. */
static void note_opening(const event_step *step, const contact_terms *of, const real *before, const int *closed)
{
  for (int i = 0; i < TRANSITIONS; i++) {
    const int k = TRANSITION[i][0], row = CONTACTS[k].normal;
    const int e = EVENT_FIRST[FIRST_TRANSITION + i];
    NAME(event_history) *const history = step->watch->history + e;
    if (TRANSITION[i][1] != CONTACT_CLOSES || mode_of(step->watch->mode, k).closed ||
        !(closed[k] || of->value[row] <= of->rounding[row]) || (of->absent[k] && of->value[row] < -of->rounding[row]) ||
        !(closed[k] || before[row] >= -of->rounding[row] - history->slack))
      continue;
    if (closed[k] || !JUST_CHANGED(step->watch, e))
      *history = (NAME(event_history)){.last = step->watch->time, .hits = 1};
    history->slack = fmax(history->slack, fabs(of->value[row]) + of->rounding[row]);
  }
}

#ifdef CONTACTS_IN_SPACE
/* Slips of a body on several feet end together (Z. Farkas et al., Phys. Rev. Lett. 90, 248302, 2003): where one stops,
 * so do slow ones that brake. The projection that removes its rate would turn them, with friction along them. */
static int stop_together(const event_step *step, event_sample *at, contact_terms *of, contact_change *now)
{
  contact_mode mode[EVENT_CONTACTS];
  real force[CONTACT_ROWS], second[CONTACT_ROWS];
  int any = 0;
  for (int k = 0; k < EVENT_CONTACTS; k++)
    any |= CONTACTS[k].slips == 2 && now->stops[k] && now->rests[k];
  if (any)
    TRY(slips_at(step, at, of, mode, force, second, &any));
  if (!any)
    return OK;
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const real *const d = mode[k].direction, *const w = second + CONTACTS[k].tangential;
    now->rests[k] |= CONTACTS[k].slips == 2 && d[0] * w[0] + d[1] * w[1] < 0.0 && stops_at(step, of, k);
  }
  return settle(step, at, of, now);
}
#endif

/* Closes contacts that touch within rounding and separate by no more than that: those of two feet alternate without end
 * where each opens until slips stop, which begin with the impact of the other. With others they stop together. */
static int rest_low(const event_step *step, event_sample *at, contact_terms *of, const real *force, const int *closed,
    contact_change *now)
{
  int any = 0;
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const int row = CONTACTS[k].normal;
    const int rests = is_met(of, now, closed, k) && fabs(of->value[row]) <= CONTACT_LOWEST * of->rounding[row] &&
        of->rate[row] > CONTACT_ROUNDING * of->speed[row] && is_low(step, of, force, 0.0, k);
    now->touches[k] |= rests;
    any |= rests;
  }
  if (any)
    TRY(settle(step, at, of, now));
#ifdef CONTACTS_IN_SPACE
  TRY(stop_together(step, at, of, now));
#endif
  return OK;
}

/* First contact whose friction acts along its slip in the present modes, -1: none; it would supply energy. */
static int find_driven(const event_step *step, const contact_terms *of)
{
  contact_mode mode[EVENT_CONTACTS];
  modes_at(of, step->watch->mode, mode);
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const real *const d = mode[k].direction, *const w = of->rate + CONTACTS[k].tangential;
    real along = 0.0;
    for (int i = 0; i < CONTACTS[k].slips && mode[k].closed && !mode[k].sticks && !mode[k].held; i++)
      along += d[i] * w[i];
    if (along < 0.0 && along < -CONTACT_ROUNDING * of->speed[CONTACTS[k].tangential])
      return k;
  }
  return -1;
}

/* Removes residuals of slips that stop against the directions in which they begin, where they would stop again. */
static int remove_residuals(const event_step *step, event_sample *at, contact_terms *of, const contact_change *now)
{
  int any = 0;
  for (int k = 0; k < EVENT_CONTACTS; k++)
    any |= now->rests[k] && CONTACTS[k].slips == 1 &&
        step->watch->mode[CONTACTS[k].direction] * of->rate[CONTACTS[k].tangential] < 0.0;
  return any ? settle(step, at, of, now) : OK;
}

/* Notes which contacts were closed, and by their modes and transitions which touch and rest, and whether a contact that
 * meets approaches, also one that just does not close yet. Fails where a coefficient is impossible. */
static int begin_change(const event_step *step, const contact_terms *of, contact_change *now, int *closed,
    int *approach)
{
  real impossible = 0.0;
  *approach = 0;
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const contact_mode mode = mode_of(step->watch->mode, k);
    if (CONTACTS[k].slips > 0)
      step->watch->fastest[k] = fmax(step->watch->fastest[k], of->speed[CONTACTS[k].tangential]);
    closed[k] = CONTACTS[k].normal >= 0 && mode.closed && !now->leaves[k];
    now->touches[k] |= closed[k];
    now->rests[k] = mode.sticks || (mode.closed && mode.held) || (now->stops[k] && stops_at(step, of, k));
    now->rests[k] &= !now->begins[k];
    const int meets = is_met(of, now, closed, k), acts = meets || (mode.closed && !now->leaves[k]);
    const int reason = acts ? impossible_reason(of, k, 0, meets, &impossible) : 0;
    if (reason)
      return refuse(step, reason, k, impossible);
    *approach |= meets &&
        of->rate[CONTACTS[k].normal] < (now->closes[k] ? 0.0 : -CONTACT_ROUNDING * of->speed[CONTACTS[k].normal]);
  }
  return OK;
}

/* Impacts and new modes at a state, which is projected onto their constraints. That may turn slow slips, and modes are
 * chosen again if it reverses these or makes forces impossible; none that remain so are kept. */
static int change_modes(const event_step *step, event_sample *at, contact_change *now)
{
  contact_terms of;
  contact_mode present[EVENT_CONTACTS];
  const real none[CONTACT_ROWS] = {0.0};
  real force[CONTACT_ROWS], before[CONTACT_ROWS];
  int closed[EVENT_CONTACTS], outside[EVENT_CONTACTS], approach, first = 0;
  step->report->t = at->t;
  TRY(terms_at(step, at, &of));
  memcpy(before, of.value, sizeof before);
  TRY(begin_change(step, &of, now, closed, &approach));
  forces_at(at->t, at->q, at->p, step->own, present, force, step->workspace);
  if (approach)
    TRY(collide(step, at, &of, closed, none, now));
  else
    TRY(rest_low(step, at, &of, force, closed, now));
  for (int pass = 0; first >= 0 && pass <= EVENT_CONTACTS; pass++) {
    const int status = choose_modes(step, &of, now, force);
    if (status != OK && step->watch->refusal == CONTACT_WITHOUT_MODE && pass < EVENT_CONTACTS &&
        jump(step, at, &of, now))
      continue;
    TRY(status);
    TRY(remove_residuals(step, at, &of, now));
    TRY(satisfy_constraints(step, at->t, at->q, at->p, 1));
    TRY(terms_at(step, at, &of));
    first = find_outside(step, &of, CONTACT_ROUNDING, outside);
    if (first < 0)
      first = find_driven(step, &of);
  }
  if (first >= 0)
    first = find_outside(step, &of, CONTACT_OUTSIDE, outside);
  if (first == EVENT_CONTACTS)
    return refuse(step, CONTACT_WITHOUT_MODE, -1, 0.0);
  else if (first >= 0)
    return refuse(step, CONTACT_LEAVES_CONE, first, 0.0);
  note_opening(step, &of, before, closed);
  return OK;
}

/* Whether others nearly hold the gap of a closed contact, as where legs pass through straight, so that rounding
 * determines its force: without that it accelerates little, and they push, with `strongest` at most. */
static int is_nearly_held(const event_step *step, const contact_terms *of, int k, real *strongest)
{
  contact_mode mode[EVENT_CONTACTS];
  real force[CONTACT_ROWS], after[CONTACT_ROWS];
  const int row = CONTACTS[k].normal;
  modes_at(of, step->watch->mode, mode);
  int holds = row >= 0 && mode[k].closed;
  mode[k] = CONTACT_IS_OPEN;
  *strongest = 0.0;
  if (holds)
    solve_contacts(of, mode, of->second, force, after, NULL);
  for (int j = 0; holds && j < EVENT_CONTACTS; j++) {
    const real normal = CONTACTS[j].normal < 0 ? 0.0 : force[CONTACTS[j].normal];
    holds = normal >= 0.0;
    *strongest = fmax(*strongest, normal);
  }
  return holds && fabs(after[row]) <= CONTACT_NEARLY_HELD * of->second_terms[row];
}

/* Opens a contact that others nearly hold, that without which they push least; whether there is one, in *opens. */
static int open_nearly_held(const event_step *step, event_sample *at, int *opens)
{
  contact_terms of;
  contact_change now;
  real strongest, least = INFINITY;
  memset(&now, 0, sizeof now);
  TRY(terms_at(step, at, &of));
  for (int k = 0; k < EVENT_CONTACTS; k++)
    if (is_nearly_held(step, &of, k, &strongest) && strongest < least) {
      memset(now.leaves, 0, sizeof now.leaves);
      now.leaves[k] = 1;
      least = strongest;
    }
  *opens = least < INFINITY;
  return *opens ? change_modes(step, at, &now) : OK;
}

#ifdef CONTACTS_IN_SPACE
/* Follows slips in space from a state; new modes where their new directions make forces impossible. Those of dependent
 * contacts only differ in the rates by the rounding of directions while slips begin. */
static int renew_slips(const event_step *step, event_sample *at, real *longest)
{
  const long long before = *step->filled;
  const real most = *longest;
  contact_change now;
  contact_terms of;
  int outside[EVENT_CONTACTS], first = -1, stops = 0;
  memset(&now, 0, sizeof now);
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    now.stops[k] = step->watch->stops[k];
    step->watch->stops[k] = 0;
    stops |= now.stops[k];
  }
  if (stops) {
    TRY(add_change(step, FIRST_TRANSITION, at));
    TRY(change_modes(step, at, &now));
  }
  TRY(follow_slips(step, at, longest));
  if (*step->filled > before) {
    TRY(terms_at(step, at, &of));
    first = find_outside(step, &of, CONTACT_ROUNDING, outside);
  }
  if (first < 0 || first == EVENT_CONTACTS)
    return OK;
  memset(&now, 0, sizeof now);
  TRY(change_modes(step, at, &now));
  *longest = most;
  return follow_slips(step, at, longest);
}
#endif

/* Modes after the transitions among the crossings from `first` on, which have one state. */
static int change_contacts(const event_step *step, long long first, event_sample *at)
{
  contact_change now;
  contact_terms of;
  real strongest;
  int changed = 0;
  memset(&now, 0, sizeof now);
  for (long long i = first; i < *step->filled; i++)
    if (is_transition(step->found[i].function)) {
      const int *const transition = TRANSITION[step->found[i].function - FIRST_TRANSITION];
      const int k = transition[0];
      now.closes[k] |= transition[1] == CONTACT_CLOSES;
      now.lifts |= transition[1] == CONTACT_LIFTS;
      if (transition[1] == CONTACT_LIFTS && step->found[i].before.hits > 0 &&
          fabs(step->watch->time - step->found[i].before.last) <= fabs(step->whole)) { /* it has just lifted */
        TRY(terms_at(step, at, &of));
        now.leaves[k] = is_nearly_held(step, &of, k, &strongest);
      }
      now.leaves[k] |= transition[1] == CONTACT_LEAVES;
      now.stops[k] |= transition[1] == CONTACT_STOPS;
      now.begins[k] += (transition[1] == CONTACT_FORWARD || transition[1] == CONTACT_BEGINS) -
          (transition[1] == CONTACT_BACKWARD);
    }
  for (long long i = first; i < *step->filled; i++) /* forces may jump at kinks, momenta at events */
    changed |= step->watch->acts[step->found[i].function];
  return changed ? change_modes(step, at, &now) : OK;
}

/* First modes of a run, after impacts of contacts that are closed and approach. */
static int begin_contacts(const event_step *step, event_sample *at)
{
  contact_terms of;
  contact_change now;
  memset(&now, 0, sizeof now);
  for (int k = 0; k < EVENT_CONTACTS; k++)
    put_mode(CONTACTS + k, CONTACT_IS_OPEN, AT_REST, 0.0, step->watch->mode);
  put_modes(step->watch->mode, step->own);
  TRY(terms_at(step, at, &of));
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const int row = CONTACTS[k].normal;
    if (row >= 0 && !of.absent[k] && of.value[row] < -CONTACT_PENETRATION * of.size[row])
      return refuse(step, CONTACT_PENETRATES, k, of.value[row]);
    for (int i = 0; i < 3; i++)
      if (!is_finite(of.coefficient[3 * k + i])) /* steps contain those of open contacts */
        return refuse(step, i < 2 ? CONTACT_IMPOSSIBLE : CONTACT_REPELS, k, of.coefficient[3 * k + i]);
    now.closes[k] = row >= 0 && !of.absent[k] && fabs(of.value[row]) <= CONTACT_ROUNDING * of.size[row];
  }
  return change_modes(step, at, &now);
}

/* Whether the function of a transition is not negative after a step without it; gaps of limited contacts may be. */
static int is_kept(int transition)
{
  const int kind = TRANSITION[transition][1];
  return kind == CONTACT_LEAVES || (kind == CONTACT_CLOSES && !IS_CONDITIONAL[FIRST_TRANSITION + transition]);
}

/* Effect of rounding on the gap or the normal force of a transition, by their terms: of forces f = -W^-1 b by those of
 * b, with W of the closed contacts and sticking slips. 0 for others, INFINITY for those that are not searched. */
static int rounding_of_contact(const event_step *step, int event, const event_sample *at, real *rounding)
{
  const int kind = TRANSITION[event - FIRST_TRANSITION][1];
  const int row = CONTACTS[TRANSITION[event - FIRST_TRANSITION][0]].normal;
  contact_terms of;
  contact_mode mode[EVENT_CONTACTS];
  real right[CONTACT_ROWS] = {0.0}, force[CONTACT_ROWS] = {0.0}, after[CONTACT_ROWS];
  *rounding = kind == CONTACT_DRIVES ? INFINITY : 0.0;
  if (kind != CONTACT_CLOSES && kind != CONTACT_LIFTS && kind != CONTACT_STOPS)
    return OK;
  TRY(terms_at(step, at, &of));
  if (kind == CONTACT_STOPS) { /* slips begin within rounding before the load at which they do */
    *rounding = DBL_EPSILON * of.speed[CONTACTS[TRANSITION[event - FIRST_TRANSITION][0]].tangential];
    return OK;
  }
  modes_at(&of, step->watch->mode, mode);
  for (int k = 0; k < EVENT_CONTACTS; k++)
    mode[k] = CONTACTS[k].normal < 0 && !mode[k].sticks ? CONTACT_IS_OPEN : mode[k]; /* of constant friction */
  right[row] = 1.0;
  if (kind == CONTACT_LIFTS)
    solve_contacts(&of, mode, right, force, after, NULL);
  *rounding = kind == CONTACT_CLOSES ? DBL_EPSILON * of.size[row] : 0.0;
  for (int r = 0; r < CONTACT_ROWS; r++)
    *rounding += 8.0 * DBL_EPSILON * fabs(force[r]) * of.second_terms[r];
  return OK;
}

/* Whether the function of a transition is that of forces in their cone. */
static int is_of_forces(int transition)
{
  const int kind = TRANSITION[transition][1];
  return kind != CONTACT_CLOSES && kind != CONTACT_LEAVES && kind != CONTACT_STOPS && kind != CONTACT_DRIVES;
}

/* Whether a gap that the rows of other contacts held at 0 has left it at a state, where they no longer determine it. */
static int is_released(const event_step *step, const event_sample *at, int k, int *released)
{
  contact_terms of;
  contact_mode mode[EVENT_CONTACTS];
  const int row = CONTACTS[k].normal;
  int rank;
  TRY(terms_at(step, at, &of));
  modes_at(&of, step->watch->mode, mode);
  *released = fabs(of.value[row]) > CONTACT_ROUNDING * of.size[row];
  if (!*released || (!mode[k].closed && of.value[row] > 0.0))
    return OK;
  mode[k] = CONTACT_IS_OPEN;
  rank = rank_of(&of, mode);
  mode[k] = CONTACT_SLIPS;
  *released = rank_of(&of, mode) > rank;
  return OK;
}

/* Adds a crossing of a transition at a fraction of a step. */
static int add_transition(const event_step *step, int transition, real fraction)
{
  event_crossing *crossing = step->found + *step->filled;
  event_sample at;
  TRY(take_sample(step, EVENT_FIRST[FIRST_TRANSITION + transition], fraction, &at));
  if (*step->filled == step->room || !place_crossing(step->watch, crossing, step->room))
    return EVENT_NO_ROOM;
  *crossing = (event_crossing){.t = at.t, .fraction = fraction, .direction = -1};
  crossing->function = FIRST_TRANSITION + transition;
  copy_state(crossing->q, crossing->p, at.q, at.p);
  ++*step->filled;
  return OK;
}

/* Ends the modes of contacts whose gaps others held, as on straight legs until knees bend: at the first of the parts of
 * a step, each twice as long, after which they are released. */
static int end_held_modes(const event_step *step, const event_sample *right)
{
  for (int i = 0; i < TRANSITIONS; i++) {
    const contact_places *const places = CONTACTS + TRANSITION[i][0];
    real fraction = 1.0, first = 0.0;
    event_sample at = *right;
    int released = TRANSITION[i][1] == CONTACT_CLOSES && step->watch->mode[places->closed] == 0.0 &&
        step->watch->mode[places->held] != 0.0;
    if (released)
      TRY(is_released(step, &at, TRANSITION[i][0], &released));
    while (released && fraction > CONTACT_START) {
      first = fraction;
      fraction *= 0.5;
      TRY(state_at(step, fraction, &at));
      TRY(is_released(step, &at, TRANSITION[i][0], &released));
    }
    if (first > 0.0)
      TRY(add_transition(step, i, first));
  }
  return OK;
}

/* Value below which a gap is negative by more than rounding. */
static real least_gap(const event_step *step, const contact_terms *of, int transition)
{
  const int e = EVENT_FIRST[FIRST_TRANSITION + transition], row = CONTACTS[TRANSITION[transition][0]].normal;
  return -CONTACT_MISSED * values_at(step, EVENT_DEGREE + 2)[e] - step->watch->history[e].slack -
      (row < 0 ? 0.0 : CONTACT_ROUNDING * of->size[row]);
}

/* Fails if friction is impossible at a node of a part of a step after its start, before its first transition. */
static int check_friction(const event_step *step)
{
  contact_terms of;
  event_sample at;
  real impossible = 0.0;
  for (int i = 0; i < TRANSITIONS; i++) {
    const int e = EVENT_FIRST[FIRST_TRANSITION + i], k = TRANSITION[i][0];
    for (int j = 1; j <= EVENT_DEGREE && TRANSITION[i][1] == CONTACT_DRIVES; j++) {
      if (!(values_at(step, j)[e] < 0.0) || EVENT_NODES[j] > step->horizon->fraction)
        continue;
      TRY(state_at(step, EVENT_NODES[j], &at));
      TRY(terms_at(step, &at, &of));
      step->report->t = at.t;
      const int reason = impossible_reason(&of, k, mode_of(step->watch->mode, k).sticks, 0, &impossible);
      if (reason)
        return refuse(step, reason, k, impossible);
    }
  }
  return OK;
}

/* Ends modes at the start of a step whose forces or gaps are negative there within rounding, and more at its end: their
 * functions have no zero. Of gaps in steps to whose end the present modes last. */
static int end_modes_at_start(const event_step *step, const event_sample *right)
{
  contact_terms of;
  const int lasts = isinf(step->horizon->fraction);
  int outside[EVENT_CONTACTS], has_terms = 0;
  TRY(check_friction(step));
  for (int i = 0; i < TRANSITIONS; i++) {
    const int e = EVENT_FIRST[FIRST_TRANSITION + i];
    const real before = values_at(step, 0)[e], after = values_at(step, EVENT_DEGREE)[e];
    if (!((is_of_forces(i) || (lasts && is_kept(i))) && before < 0.0 && after < before))
      continue;
    if (!has_terms) {
      TRY(terms_at(step, right, &of));
      find_outside(step, &of, CONTACT_OUTSIDE, outside);
    }
    has_terms = 1;
    if (is_of_forces(i) ? outside[TRANSITION[i][0]] : after < least_gap(step, &of, i))
      TRY(add_transition(step, i, CONTACT_START));
  }
  return end_held_modes(step, right);
}

/* Fails if a gap is negative at the end of a step without a transition, or forces are outside of their cone. */
static int check_gaps(const event_step *step, const event_sample *right)
{
  contact_terms of;
  real value[EVENTS];
  int outside[EVENT_CONTACTS], doubtful = 0;
  TRY(evaluate_functions(step, right, value));
  for (int i = 0; i < TRANSITIONS; i++)
    doubtful |= value[EVENT_FIRST[FIRST_TRANSITION + i]] < 0.0;
  if (!doubtful)
    return OK;
  memcpy(values_at(step, 0), value, BYTES(EVENTS));
  TRY(rounding_of(step, right));
  TRY(terms_at(step, right, &of));
  find_outside(step, &of, CONTACT_OUTSIDE, outside);
  for (int i = 0; i < TRANSITIONS; i++) {
    const int e = EVENT_FIRST[FIRST_TRANSITION + i];
    const int is_less = is_of_forces(i) ? outside[TRANSITION[i][0]] : is_kept(i) && value[e] < least_gap(step, &of, i);
    if (value[e] < 0.0 && is_less) {
      step->watch->through = FIRST_TRANSITION + i + 1;
      return NOT_CONVERGED;
    }
  }
  return OK;
}
