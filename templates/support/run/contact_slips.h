#include "contact_modes.h"

/* Directions of slips in space where these stop and begin. */
enum {
  CONTACT_TURNS = 8 /* iterations for directions at the end of a part */
};

#define CONTACT_BRAKES 0.25 /* longest parts relative to the time to its stop .. */
#define CONTACT_GROWS 0.2 /* .. to that from its beginning .. */
#define CONTACT_RELAXES 2.0 /* .. and to the relaxation of its direction, for which iterations on stages converge */
#define CONTACT_STIFF 0.25 /* relaxation relative to a part and those times, below which it is not followed */
#define CONTACT_BRAKED 0.03 /* braking relative to friction, above which slow slips keep their direction to the stop */
#define CONTACT_TURNED 1e-7 /* change of a direction at which iterations end */
#define CONTACT_GAMMA 0.2928932188134524 /* 1 - 1/sqrt(2), of the rule for directions of slips */
#define CONTACT_ACCURACY 4e-10 /* error of slips that turn in a part, relative to the fastest one .. */
#define CONTACT_PATH 2e-3 /* .. and the weight of that of paths, relative to that of a step */
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
  *any = solve_contacts(of, mode, of->second, force, second, NULL) <= CONTACT_OUTSIDE;
  return OK;
}

/* Sets the direction of a slip in space; `keeps`: that of friction in the next part of a step, whose share of the limit
 * is its length. A slip stops where that along `ahead` does. */
static void direct_slip(const event_step *step, int k, const real *direction, const real *ahead, int keeps)
{
  real *const start = step->watch->mode + CONTACTS[k].direction + 1;
  const real share = length_of(direction, 2), fast = CONTACT_FAST * step->watch->fastest[k];
  start[-1] = share < 1.0 - CONTACT_ROUNDING ? fmax(share, DBL_EPSILON) : 1.0;
  for (int i = 0; i < 2; i++) {
    start[i] = keeps ? fast * fast * direction[i] / fmax(share, DBL_MIN) : 0.0;
    start[2 + i] = ahead[i];
  }
}

/* Directions of slips that turn in a part of a step: d at the end of one of its stages, where slips are w, and friction
 * brakes them by so much; a part of the friction, `given`, is along -base, the rest along -d. */
typedef struct {
  real part, given, base[EVENT_CONTACTS][2], d[EVENT_CONTACTS][2], w[EVENT_CONTACTS][2], brake[EVENT_CONTACTS];
  int stops[EVENT_CONTACTS];
} slip_stage;

/* Solves for forces at the end of a stage, with rates there as functions of the forces near those in the present
 * directions: the part of friction that is not given is in its cone, and opposite to slips. */
static int forces_at_end(const event_step *step, const event_sample *at, const slip_stage *stage, const int *turns,
    contact_terms *end, contact_mode *mode, real *right, real *force)
{
  event_sample next = {.t = at->t + stage->part, .q = step->memory, .p = step->memory + M};
  cone_problem in;
  real after[CONTACT_ROWS];
  solver_report own;
  put_modes(step->watch->mode, step->own);
  TRY(NAME(step)(at->t, stage->part, at->q, at->p, step->own, step->options, next.q, next.p, &own, step->workspace));
  TRY(terms_at(step, &next, end));
  modes_at(end, step->watch->mode, mode);
  solve_contacts(end, mode, end->second, force, after, NULL);
  memcpy(right, end->second, BYTES(CONTACT_ROWS));
  memset(&in, 0, sizeof in);
  in.W = end->W;
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const int slip = CONTACTS[k].tangential;
    const real part = turns[k] ? stage->given : 1.0;
    in.takes_part[k] = mode[k].closed;
    in.mu[k] = end->coefficient[3 * k + (mode[k].sticks && !turns[k])];
    for (int i = 0; i < CONTACTS[k].slips; i++)
      in.given[k][i] = part * (turns[k] ? stage->base[k][i] : mode[k].sticks ? 0.0
                                                                             : mode[k].direction[i]);
    for (int i = 0; i < 2 && turns[k]; i++)
      right[slip + i] += end->rate[slip + i] / stage->part - after[slip + i];
  }
  memcpy(in.b, right, sizeof in.b);
  memcpy(in.terms, end->second_terms, sizeof in.terms);
  memcpy(in.f, force, sizeof in.f);
  const int solved = solve_cone(&in);
  memcpy(force, in.f, sizeof in.f);
  return solved ? OK : NOT_CONVERGED;
}

/* Directions at the end of a stage by forces there, and their largest change. Others that stick may begin: *begin. */
static real redirect_slips(const event_step *step, const contact_terms *end, const contact_mode *mode,
    const real *right, const real *force, int *turns, slip_stage *stage, int *begin)
{
  real change = 0.0;
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const int slip = CONTACTS[k].tangential;
    const int begins = CONTACTS[k].slips == 2 && mode[k].sticks == 3 && step->watch->mode[CONTACTS[k].held] == 0.0;
    const real least = CONTACT_ROUNDING * step->watch->fastest[k];
    const int rests = turns[k] && length_of(end->rate + slip, 2) <= least; /* by friction of the present direction */
    const real limit = (turns[k] && !rests) || begins ? friction_limit(end, k, begins, force) : 0.0;
    for (int i = 0; turns[k] && rests && i < 2; i++)
      stage->w[k][i] = 0.0;
    for (int i = 0; limit > 0.0 && i < 2; i++)
      stage->w[k][i] = stage->part * rate_after(end, right, force, slip + i);
    if (limit <= 0.0 || (begins && length_of(stage->w[k], 2) <= least))
      continue;
    for (int i = 0; i < 2; i++) {
      const real d = (-force[slip + i] / limit - stage->given * stage->base[k][i]) / (1.0 - stage->given);
      change = fmax(change, fabs(d - stage->d[k][i]));
      stage->d[k][i] = d;
    }
    if (begins)
      put_mode(CONTACTS + k, (contact_mode){.closed = 1}, AT_REST, 0.0, step->watch->mode);
    stage->brake[k] = limit * end->W[slip * (CONTACT_ROWS + 1)];
    *begin |= begins;
    turns[k] = 1;
  }
  return change;
}

/* Solves for the directions at the end of a stage, until others begin. */
static int solve_stage(const event_step *step, const event_sample *at, int *turns, slip_stage *stage, int *begin)
{
  contact_terms end;
  contact_mode mode[EVENT_CONTACTS];
  real right[CONTACT_ROWS], force[CONTACT_ROWS], mean[2];
  for (int pass = 0; pass < CONTACT_TURNS; pass++) {
    for (int k = 0; k < EVENT_CONTACTS; k++) {
      for (int i = 0; i < 2; i++)
        mean[i] = stage->given * stage->base[k][i] + (1.0 - stage->given) * stage->d[k][i];
      if (turns[k])
        direct_slip(step, k, mean, AT_REST, 1);
    }
    TRY(forces_at_end(step, at, stage, turns, &end, mode, right, force));
    if (redirect_slips(step, &end, mode, right, force, turns, stage, begin) <= CONTACT_TURNED || *begin)
      return OK;
  }
  return NOT_CONVERGED;
}

/* Error of a slip by a part: along it of second order in its turn, or less where it is slow; that of its path; what
 * friction gains; and the slip from its stop on, until which *stops of the part lasts. */
static real error_of_turn(const event_step *step, const contact_terms *of, int k, slip_stage *last, real *stops)
{
  const real *const w = of->rate + CONTACTS[k].tangential, *const d = last->d[k], *const end = last->w[k];
  const real speed = length_of(w, 2), brake = last->brake[k] * fabs(last->part);
  const real spare = CONTACT_GAMMA * brake * (1.0 - length_of(d, 2)), kept = speed / fmax(speed + spare, DBL_MIN);
  const real path = CONTACT_PATH * brake * fabs(last->part / step->whole);
  const int is_slow = speed <= CONTACT_SLOW * step->watch->fastest[k]; /* by rounding, without a direction */
  real turn = 0.0, work = 0.0;
  for (int i = 0; i < 2; i++) {
    turn = hypot(turn, d[i] - (is_slow ? last->base[k][i] : w[i] / speed));
    work += is_slow ? 0.0 : (last->given * last->base[k][i] + CONTACT_GAMMA * d[i]) * (w[i] + end[i]);
  }
  if (is_slow || spare * kept <= CONTACT_ACCURACY * step->watch->fastest[k])
    return turn * (fmin(fmax(speed, length_of(end, 2)), brake * turn) + path) - fmin(work, 0.0);
  last->stops[k] = 1;
  *stops = fmin(*stops, kept);
  return INFINITY;
}

/* Directions of slips that relax in a part of a step, by a rule of second order that damps them (R. Alexander, SIAM J.
 * Numer. Anal. 14, 1977): friction is opposite to the slip at the end of a stage gamma part, and then, with 1 - gamma
 * times that, at the end of the part; it is in its cone if the slip there is 0. The part becomes shorter until errors
 * are small, and slips that stop do so at its end. */
static int turn_slips(const event_step *step, const event_sample *at, const contact_terms *of, int *turns,
    const contact_mode *mode, real *part)
{
  const real least = CONTACT_UNSOLVED * fabs(step->whole), longest = *part;
  slip_stage first = {.part = 0.0}, last = {.given = 1.0 - CONTACT_GAMMA};
  real worst = INFINITY;
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    memcpy(first.d[k], mode[k].direction, sizeof first.d[k]);
    memcpy(last.d[k], mode[k].direction, sizeof last.d[k]);
  }
  while (worst > CONTACT_ACCURACY) {
    int begin = 0;
    real stops = 1.0;
    first.part = CONTACT_GAMMA * *part;
    last.part = *part;
    int status = solve_stage(step, at, turns, &first, &begin);
    memcpy(last.base, first.d, sizeof first.d);
    if (status == OK && !begin)
      status = solve_stage(step, at, turns, &last, &begin);
    if (status == OK && begin)
      continue;
    worst = status == OK ? 0.0 : INFINITY;
    for (int k = 0; k < EVENT_CONTACTS && status == OK; k++)
      if (turns[k])
        worst = fmax(worst, error_of_turn(step, of, k, &last, &stops) / step->watch->fastest[k]);
    if (worst <= CONTACT_ACCURACY || fabs(*part) <= least) { /* what is shorter is rounding */
      TRY(status);
      break;
    }
    *part *= fmax(0.125, stops < 1.0 ? stops : 0.75 * cbrt(CONTACT_ACCURACY / worst));
  }
  const real next = *part * fmin(2.0, 0.9 * cbrt(CONTACT_ACCURACY / fmax(worst, DBL_MIN)));
  for (int k = 0; k < EVENT_CONTACTS; k++)
    if (turns[k]) {
      const int slows = last.stops[k] && length_of(last.w[k], 2) <= CONTACT_SLOW * step->watch->fastest[k];
      step->watch->stops[k] = slows || length_of(last.d[k], 2) < 1.0 - CONTACT_ROUNDING;
      step->watch->part[k] = fmax(next, *part < longest ? 0.0 : step->watch->part[k]);
    }
  return OK;
}

/* Times of a slip in space, and what is done with its direction at the beginning of a part of a step: it is kept, new,
 * or turned in the part. by_rate: to its stop or from its beginning; relaxes: of its direction. */
typedef struct {
  int moves, stops, may_keep, keeps, renews, is_stiff;
  real by_rate, relaxes;
} slip_pace;

static slip_pace pace_of(const event_step *step, const contact_terms *of, int k, const contact_mode *mode,
    const real *force, const real *second)
{
  const int slip = CONTACTS[k].tangential;
  const real *const start = step->watch->mode + CONTACTS[k].direction + 1, *const w = of->rate + slip;
  const real *const d = mode->direction, size = length_of(w, 2);
  slip_pace pace = {.moves = CONTACTS[k].slips == 2 && start[-1] != 0.0 && !mode->held};
  if (!pace.moves)
    return pace;
  real *const fastest = step->watch->fastest + k;
  const real rate = d[0] * second[slip] + d[1] * second[slip + 1];
  const real by_friction = length_of(force + slip, 2) * of->W[slip * (CONTACT_ROWS + 1)];
  const int kept = keeps_direction(start, w);
  pace.stops = rate < -CONTACT_ROUNDING * by_friction;
  *fastest = fmax(*fastest, fmax(size, of->speed[slip]));
  pace.by_rate = (pace.stops ? CONTACT_BRAKES : CONTACT_GROWS) * fmax(size, CONTACT_SLOW * *fastest) / fabs(rate);
  pace.relaxes = CONTACT_RELAXES * size / by_friction;
  pace.is_stiff = CONTACT_RELAXES * rate <= CONTACT_STIFF * CONTACT_GROWS * by_friction;
  pace.may_keep = rate < -CONTACT_BRAKED * by_friction || !pace.is_stiff;
  pace.keeps = pace.may_keep && size <= CONTACT_SLOW * *fastest;
  pace.renews = pace.keeps != kept || (!kept && start[2] * w[0] + start[3] * w[1] < CONTACT_TURN * size);
  return pace;
}

/* Gives a slip w the direction of its rate, or if that is 0 its own; `keeps`: in the next part of a step. */
static void renew_direction(const event_step *step, int k, const real *w, real *direction, int keeps)
{
  const real speed = length_of(w, 2);
  for (int i = 0; speed > 0.0 && i < 2; i++)
    direction[i] = w[i] / speed;
  direct_slip(step, k, direction, direction, keeps);
}

/* Slips in space at the beginning of a part of a step, of at most *longest. Where they stop and where they begin
 * solutions are not smooth: parts are in proportion to |w|/|w'|, and to the time |w|/(W tau) in which the direction
 * relaxes to that of other forces. Slow ones that stop or begin by a jump of friction keep their direction, and those
 * that relax faster than all else turn by the rule above. The direction `ahead` of others is renewed after a turn. */
static int follow_slips(const event_step *step, const event_sample *at, real *longest)
{
  contact_terms of;
  contact_mode mode[EVENT_CONTACTS];
  slip_pace pace[EVENT_CONTACTS];
  real force[CONTACT_ROWS], second[CONTACT_ROWS], part = *longest, smooth = INFINITY;
  const real uncut = step->watch->is_cut ? fmax(part, step->watch->pace) : part;
  int turns[EVENT_CONTACTS] = {0}, turning = 0, stopping = 0, changes = 0, status = OK, any;
  *longest = INFINITY;
  TRY(slips_at(step, at, &of, mode, force, second, &any));
  if (!any)
    return OK;
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    pace[k] = pace_of(step, &of, k, mode + k, force, second);
    if (pace[k].moves && !pace[k].keeps)
      smooth = fmin(smooth, pace[k].by_rate);
  }
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const int keeps = pace[k].keeps, follows = pace[k].moves && !keeps;
    const real size = pace[k].stops ? uncut : part; /* adaptive steps would shrink with a slip to its stop */
    turns[k] = follows && pace[k].is_stiff && pace[k].relaxes <= CONTACT_STIFF * fmin(size, smooth);
    turning |= turns[k];
    stopping |= turns[k] && pace[k].stops;
    changes |= turns[k] || pace[k].renews;
    if (keeps && !pace[k].is_stiff)
      *longest = fmin(*longest, fmax(CONTACT_BEGIN * fabs(step->whole), pace[k].by_rate));
    if (follows)
      *longest = fmin(*longest, turns[k] ? step->watch->part[k] : fmin(pace[k].by_rate, pace[k].relaxes));
    step->watch->part[k] = turns[k] ? step->watch->part[k] : INFINITY;
  }
  part = fmin(stopping ? uncut : part, *longest);
  if (changes)
    TRY(add_change(step, FIRST_TRANSITION, at));
  for (int k = 0; k < EVENT_CONTACTS; k++)
    if (pace[k].renews && !turns[k])
      renew_direction(step, k, of.rate + CONTACTS[k].tangential, mode[k].direction, pace[k].keeps);
  if (turning) {
    status = turn_slips(step, at, &of, turns, mode, &part);
    *longest = part;
  }
  if (status != OK)
    --*step->filled; /* the part is taken again */
  put_modes(step->watch->mode, step->own);
  return status;
}
#endif
