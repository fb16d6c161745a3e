#include "contact_modes.h"

/* Directions of slips in space where these stop and begin. */
#define CONTACT_BEGIN 1e-4 /* first part of a slip in space, relative to a step: longer than that of rounding */
#define CONTACT_BRAKES 0.25 /* longest parts relative to the time to its stop .. */
#define CONTACT_GROWS 0.2 /* .. to that from its beginning .. */
#define CONTACT_RELAXES 2.0 /* .. and to the relaxation of its direction, for which iterations on stages converge .. */
#define CONTACT_BRAKING 4.0 /* .. and of slips that brake */
#define CONTACT_SHORT 3e-4 /* .. once that is longer than this part of a step */
/* Least size of an adaptive step for this, relative to the largest so far: the energy of a stool that falls on its feet
 * grows without bound for 0, and by 1e-8, 7e-11, 3e-12, 8e-13, 8e-13 for 2^-12, 2^-9, 2^-6, 2^-3, 1. */
#define CONTACT_PACE 0x1p-6
/* Relative to that: shorter parts of a step are not halved if they are unsolved, as rounding of positions would change
 * momenta by more than errors of steps: energies of legs that pass straight would grow by 4e-8 for 2^-30. */
#define CONTACT_UNSOLVED 0x1p-20
#define CONTACT_TURN 0.866 /* cosine of an angle after which a direction is renewed */

#ifdef CONTACTS_IN_SPACE
/* Adds a change of the modes at a state to the crossings. */
static int add_change(const event_step *step, int event, const event_sample *at)
{
  event_crossing *crossing = step->found + *step->filled;
  if (*step->filled == step->room || !place_crossing(step->watch, crossing, step->room))
    return EVENT_NO_ROOM;
  crossing->t = at->t;
  crossing->function = event;
  crossing->direction = 0;
  crossing->element = 0;
  crossing->acted = 1;
  crossing->before = step->watch->history[EVENT_FIRST[event]];
  memcpy(crossing->mode, step->watch->mode, BYTES(EVENT_MODES));
  copy_state(crossing->q, crossing->p, at->q, at->p);
  ++*step->filled;
  return OK;
}

/* Whether the direction (ahead.w) w + start of a slip in space is that of its second term. */
static int keeps_direction(const real *start, const real *w)
{
  return length_of(start, 2) > length_of(w, 2) * length_of(w, 2);
}

/* Present modes, the forces and second rates in them, if there are slips in space (*any), and forces. */
static int slips_at(const event_step *step, const event_sample *at, contact_terms *of, contact_mode *mode, real *force,
    real *second, int *any)
{
  const real *const modes = step->watch->mode;
  *any = 0;
  for (int k = 0; k < EVENT_CONTACTS; k++)
    *any |= CONTACTS[k].slips == 2 && modes[CONTACTS[k].direction] != 0.0 && !mode_of(modes, k).held;
  if (!*any)
    return OK;
  TRY(terms_at(step, at, of));
  modes_at(of, modes, mode);
  *any = solve_contacts(of, mode, of->second, force, second, NULL) <= CONTACT_ROUNDING;
  return OK;
}

/* Directions in a part of a step of slips that begin, by the midpoint rule: friction is opposite to w + (part/2) w', w'
 * that of the middle. At the beginning, w = 0, that is w' parallel to -d where friction jumps; where it does not jump,
 * w' = 0, the friction at rest, which w follows as long as the friction that would stop it is stiff. */
static int turn_slips(const event_step *step, const event_sample *at, const contact_terms *of, const int *begins,
    contact_mode *mode, real *force, real part)
{
  event_sample middle = {.t = at->t + 0.5 * part, .q = step->memory, .p = step->memory + M};
  contact_terms there;
  contact_problem in = {.of = &there};
  real right[CONTACT_ROWS];
  solver_report own;
  TRY(NAME(step)(at->t, 0.5 * part, at->q, at->p, step->own, step->options, middle.q, middle.p, &own,
      step->workspace));
  TRY(terms_at(step, &middle, &there));
  memcpy(right, there.second, sizeof right);
  in.right = right;
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const int slip = CONTACTS[k].tangential;
    in.limit[k] = mode[k].sticks != 0;
    if (!begins[k])
      continue;
    mode[k] = CONTACT_STICKS;
    for (int i = 0; i < 2; i++)
      right[slip + i] += 2.0 / part * of->rate[slip + i];
  }
  memcpy(in.role, mode, sizeof in.role);
  relax(&in, 0.0, CONTACT_SWEEPS, force);
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const real *const tau = force + CONTACTS[k].tangential, size = length_of(tau, 2);
    for (int i = 0; begins[k] && size > 0.0 && i < 2; i++) /* without a force any direction is right */
      mode[k].direction[i] = -tau[i] / size;
  }
  return OK;
}

/* Slips in space at the beginning of a part of a step, of at most *longest. Where they stop and where they begin
 * solutions are not smooth: parts are in proportion to |w|/|w'|, and to the time |w|/(W tau) in which the direction
 * relaxes to that of other forces. Slow ones that stop keep their direction, and those that begin that of the middle of
 * each part, until parts of relaxation are no longer short. The direction `ahead` of others is renewed after a turn. */
static int follow_slips(const event_step *step, const event_sample *at, real *longest)
{
  contact_terms of;
  contact_mode mode[EVENT_CONTACTS];
  real force[CONTACT_ROWS], second[CONTACT_ROWS], direction[EVENT_CONTACTS][2], most = *longest;
  int keeps[EVENT_CONTACTS], begins[EVENT_CONTACTS], changes = 0, turns = 0, any;
  *longest = INFINITY;
  TRY(slips_at(step, at, &of, mode, force, second, &any));
  if (!any)
    return OK;
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const int slip = CONTACTS[k].tangential;
    const real *const start = step->watch->mode + CONTACTS[k].direction + 1, *const ahead = start + 2;
    const real *const w = of.rate + slip, size = length_of(w, 2), *const d = mode[k].direction;
    keeps[k] = -1;
    begins[k] = 0;
    if (CONTACTS[k].slips < 2 || start[-1] == 0.0 || mode[k].held)
      continue;
    const real rate = d[0] * second[slip] + d[1] * second[slip + 1];
    const real by_friction = length_of(force + slip, 2) * of.W[slip * (CONTACT_ROWS + 1)];
    const real part = (rate < 0.0 ? CONTACT_BRAKES : CONTACT_GROWS) * size / fabs(rate);
    const real relaxes = CONTACT_RELAXES * size / by_friction;
    const real whole = step->watch->whole[k], age = fabs(step->watch->time - step->watch->began[k]);
    const int kept = keeps_direction(start, w), stops = rate < -CONTACT_ROUNDING * by_friction;
    const int stiff = CONTACT_GROWS * by_friction > CONTACT_RELAXES * rate && relaxes < CONTACT_SHORT * whole;
    step->watch->fastest[k] = fmax(step->watch->fastest[k], fmax(size, of.speed[slip]));
    keeps[k] = stops ? size <= CONTACT_SLOW * step->watch->fastest[k] : kept && (age == 0.0 || stiff);
    begins[k] = keeps[k] && !stops && age > 0.0;
    if (keeps[k] && !stops)
      *longest = fmin(*longest, fmax(CONTACT_BEGIN * whole, CONTACT_GROWS * age));
    else if (!keeps[k])
      *longest = fmin(*longest, fmin(part, stops ? CONTACT_BRAKING * relaxes : relaxes));
    turns |= begins[k];
    changes |= begins[k] || keeps[k] != kept || (!kept && ahead[0] * w[0] + ahead[1] * w[1] < CONTACT_TURN * size);
    for (int i = 0; i < 2; i++)
      direction[k][i] = size > 0.0 && !(keeps[k] && kept) ? w[i] / size : ahead[i];
  }
  if (turns)
    TRY(turn_slips(step, at, &of, begins, mode, force, fmin(*longest, most)));
  if (changes)
    TRY(add_change(step, FIRST_TRANSITION, at));
  for (int k = 0; changes && k < EVENT_CONTACTS; k++) {
    real *const start = step->watch->mode + CONTACTS[k].direction + 1;
    for (int i = 0; keeps[k] >= 0 && i < 2; i++) {
      start[2 + i] = begins[k] ? mode[k].direction[i] : direction[k][i];
      start[i] = keeps[k] ? pow(CONTACT_FAST * step->watch->fastest[k], 2.0) * start[2 + i] : 0.0;
    }
  }
  put_modes(step->watch->mode, step->own);
  return OK;
}
#endif
