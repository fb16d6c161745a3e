#include "contact_modes.h"

/* Impacts of contacts with friction (C. Glocker & F. Pfeiffer, Nonlinear Dyn. 7, 1995). */
enum {
  CONTACT_IMPACTS = 100, /* of a contact in a corner */
  CONTACT_SECANTS = 50 /* for the rate after a restitution */
};

/* Laws of impact, each where those before create kinetic energy: restitution of rates (Newton), of impulses (Poisson),
 * none. */
enum {
  CONTACT_NEWTON,
  CONTACT_POISSON,
  CONTACT_PLASTIC
};

#define CONTACT_SLIGHT 1e-4 /* part of the rates of bodies of which those of an impact are at least */
#define CONTACT_RESIDUALS 16.0 /* residuals of its located zero below which a rebound ends */
#define CONTACT_AHEAD 1e-5 /* time step of an impact without collision, relative to that in which a slip would stop */
#define CONTACT_GAIN 1e-9 /* part of the work of an impact by which energy may grow */

/* Impulses of contacts that meet with the given rates, by Newton's law or without restitution, and of those that are
 * closed, in consistent modes, found from the impulses given; 0 if there are none. */
static int impulses_of(const contact_terms *of, const int *meets, const int *closed, int law, const real *rate,
    real *impulse)
{
  real right[CONTACT_ROWS], after[CONTACT_ROWS], scale[CONTACT_ROWS];
  contact_problem in = {.of = of, .scale = scale};
  contact_mode mode[EVENT_CONTACTS];
  memcpy(right, rate, sizeof right);
  in.right = right;
  for (int r = 0; r < CONTACT_ROWS; r++)
    scale[r] = CONTACT_SLIGHT * of->speed[r];
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const int normal = CONTACTS[k].normal;
    in.is_free[k] = normal < 0 || !(meets[k] || closed[k]);
    if (meets[k] && law == CONTACT_NEWTON)
      right[normal] *= 1.0 + of->coefficient[3 * k + 2];
    in.rests[k] = !in.is_free[k] && CONTACTS[k].slips > 0;
    in.role[k] = in.is_free[k] ? CONTACT_IS_OPEN : in.rests[k] ? CONTACT_STICKS
                                                               : CONTACT_SLIPS;
  }
  return relax_modes(&in, impulse, mode) && is_consistent(&in, mode, impulse, after);
}

/* Adds to the impulses of a compression those of a restitution, with e times its normal impulse in the friction cone
 * (C. Glocker & F. Pfeiffer, Nonlinear Dyn. 7, 1995): as those of a contact that approaches with a rate, which follows
 * by secants. */
static int restitute(const contact_terms *of, int contact, const int *meets, const int *closed, const real *rate,
    real *impulse)
{
  const int normal = CONTACTS[contact].normal;
  const real goal = of->coefficient[3 * contact + 2] * impulse[normal];
  real after[CONTACT_ROWS], added[CONTACT_ROWS] = {0.0}, low = 0.0, of_low = 0.0;
  real high = -of->coefficient[3 * contact + 2] * rate[normal];
  int exists = 1, differs = goal > 0.0;
  for (int r = 0; r < CONTACT_ROWS; r++) {
    after[r] = rate[r];
    for (int j = 0; j < CONTACT_ROWS; j++)
      after[r] += of->W[r * CONTACT_ROWS + j] * impulse[j];
  }
  for (int k = 0; exists && differs && k < CONTACT_SECANTS; k++) {
    after[normal] = -high;
    memset(added, 0, sizeof added);
    exists = impulses_of(of, meets, closed, CONTACT_PLASTIC, after, added);
    const real slope = (added[normal] - of_low) / (high - low);
    low = high;
    of_low = added[normal];
    differs = fabs(of_low - goal) > 4.0 * DBL_EPSILON * goal;
    high += (goal - of_low) / slope;
  }
  for (int r = 0; exists && goal > 0.0 && r < CONTACT_ROWS; r++)
    impulse[r] += added[r];
  return exists && !differs;
}

/* Adds to impulses those of the rows of contacts that approach, one after another, until none does, by a law of
 * restitution, in the friction cone; simultaneous ones with those that touch and do not separate, by Newton's law,
 * which creates no energy without friction: T+ - T- = sum of (1 - e) Lambda v_n- / 2. Closed contacts take part with
 * e = 0. */
static int find_impulses(const event_step *step, const contact_terms *of, const int *approaches, const int *closed,
    int law, real *total)
{
  for (int round = 0; round < CONTACT_IMPACTS * EVENT_CONTACTS; round++) {
    real rate[CONTACT_ROWS], impulse[CONTACT_ROWS] = {0.0};
    int meets[EVENT_CONTACTS], shut[EVENT_CONTACTS], first = -1, several = 0;
    for (int r = 0; r < CONTACT_ROWS; r++)
      rate[r] = rate_after(of, of->rate, total, r);
    for (int k = EVENT_CONTACTS - 1; k >= 0; k--)
      if (approaches[k] && rate[CONTACTS[k].normal] < -CONTACT_ROUNDING * of->speed[CONTACTS[k].normal])
        first = k;
    if (first < 0)
      return OK;
    for (int k = 0; k < EVENT_CONTACTS; k++) {
      const int normal = CONTACTS[k].normal, impacts = CONTACTS[k].impacts;
      const int together = impacts == CONTACT_SIMULTANEOUS && impacts == CONTACTS[first].impacts && approaches[k];
      meets[k] = k == first || (together && rate[normal] <= CONTACT_ROUNDING * of->speed[normal]);
      several |= k != first && meets[k];
      shut[k] = closed[k] || (approaches[k] && of->coefficient[3 * k + 2] == 0.0);
    }
    if (several && law != CONTACT_NEWTON)
      return refuse(step, CONTACT_GAINS_ENERGY, first, 0.0);
    if (!impulses_of(of, meets, shut, law, rate, impulse) ||
        (law == CONTACT_POISSON && !restitute(of, first, meets, shut, rate, impulse)))
      return refuse(step, CONTACT_WITHOUT_IMPULSE, first, 0.0);
    for (int r = 0; r < CONTACT_ROWS; r++)
      total[r] += impulse[r];
  }
  return refuse(step, CONTACT_IN_CORNER, -1, 0.0);
}

/* Kinetic energy that impulses create, relative to the sizes of its terms. */
static real gain_of(const contact_terms *of, const real *impulse)
{
  real gain = 0.0, size = 0.0;
  for (int r = 0; r < CONTACT_ROWS; r++) {
    gain += 0.5 * impulse[r] * (of->rate[r] + rate_after(of, of->rate, impulse, r));
    size += impulse[r] * of->rate[r];
  }
  return size != 0.0 ? gain / fabs(size) : 0.0;
}

/* Whether the height w^2 / (2 g'') of a rebound is of the size of rounding, or of the residuals of the located zeros of
 * the contacts that meet, which a projection moves; of a gap that moves, of that of the search, which sees no rounding
 * of time. g'' contains the forces of other contacts before the impact: in free fall joints have none without them. */
static int is_low(const event_step *step, const contact_terms *of, const real *force, real residual, int k)
{
  const int row = CONTACTS[k].normal;
  const real second = fmin(of->second[row], rate_after(of, of->second, force, row));
  real lowest = CONTACT_LOWEST * of->rounding[row] + CONTACT_RESIDUALS * residual;
  for (int i = 0; i < TRANSITIONS && of->drift[row] > CONTACT_ROUNDING * of->speed[row]; i++)
    if (TRANSITION[i][0] == k && TRANSITION[i][1] == CONTACT_CLOSES)
      lowest += 4.0 * step->watch->history[EVENT_FIRST[FIRST_TRANSITION + i]].slack;
  return of->rate[row] * of->rate[row] <= -2.0 * second * lowest;
}

/* Adds impulses to the momenta. */
static int push(const event_step *step, event_sample *at, contact_terms *of, const real *impulse)
{
  for (int r = 0; r < CONTACT_ROWS; r++)
    for (int i = 0; i < M; i++)
      at->p[i] += of->G[r * M + i] * impulse[r];
  return terms_at(step, at, of);
}

/* Removes the rates of low rebounds from contacts that touch, with slips that rest: slips that remain have the
 * direction of their friction. */
static int settle(const event_step *step, event_sample *at, contact_terms *of, const contact_change *now)
{
  contact_mode mode[EVENT_CONTACTS];
  real impulse[CONTACT_ROWS], after[CONTACT_ROWS];
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    mode[k] = now->rests[k] ? CONTACT_STICKS : CONTACT_SLIPS;
    if (CONTACTS[k].normal >= 0 && !now->touches[k])
      mode[k] = CONTACT_IS_OPEN;
  }
  const real discord = solve_rows(of, mode, of->rate, of->rate, impulse, after, NULL);
  return discord > CONTACT_ROUNDING ? OK : push(step, at, of, impulse);
}

/* Whether a contact meets: its gap closes, or is 0 within rounding and it was open. */
static int is_met(const contact_terms *of, const contact_change *now, const int *closed, int k)
{
  const int normal = CONTACTS[k].normal;
  return normal >= 0 && !of->absent[k] && !now->leaves[k] &&
      (now->closes[k] || (!closed[k] && fabs(of->value[normal]) <= CONTACT_ROUNDING * of->size[normal]));
}

/* Impulses of all contacts that meet at a state after those of others, by the first law that creates no kinetic
 * energy, and which contacts touch and rest afterwards. */
static int collide(const event_step *step, event_sample *at, contact_terms *of, const int *closed, const real *others,
    contact_change *now)
{
  const contact_terms before = *of;
  contact_mode present[EVENT_CONTACTS];
  real impulse[CONTACT_ROWS], force[CONTACT_ROWS], residual = 0.0;
  int approaches[EVENT_CONTACTS], law = CONTACT_NEWTON, status;
  forces_at(at->t, at->q, at->p, step->own, present, force, step->workspace);
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const int normal = CONTACTS[k].normal;
    approaches[k] = is_met(of, now, closed, k);
    residual = fmax(residual, approaches[k] ? fabs(of->value[normal]) : 0.0);
  }
  memcpy(impulse, others, sizeof impulse);
  status = find_impulses(step, of, approaches, closed, law, impulse);
  while (status == OK ? law < CONTACT_PLASTIC && gain_of(of, impulse) > CONTACT_GAIN : law == CONTACT_POISSON) {
    step->watch->refusal = 0;
    memcpy(impulse, others, sizeof impulse);
    status = find_impulses(step, of, approaches, closed, ++law, impulse);
  }
  step->watch->law = law > step->watch->law ? law : step->watch->law;
  if (status == OK)
    status = push(step, at, of, impulse);
  for (int k = 0; status == OK && k < EVENT_CONTACTS; k++) {
    const int normal = CONTACTS[k].normal, slip = CONTACTS[k].tangential, slips = CONTACTS[k].slips;
    if (slips > 0)
      now->rests[k] = !now->begins[k] && length_of(of->rate + slip, slips) <= CONTACT_ROUNDING * before.speed[slip];
    if (normal < 0 || !(approaches[k] || closed[k]))
      continue;
    if (impulse[normal] > 0.0 && (closed[k] || law == CONTACT_PLASTIC || before.coefficient[3 * k + 2] == 0.0))
      now->touches[k] = 1;
    if (of->rate[normal] > CONTACT_ROUNDING * before.speed[normal])
      now->touches[k] = 0;
    if (step->watch->accumulates[k] || is_low(step, of, force, residual, k))
      now->touches[k] = 1;
    step->watch->accumulates[k] = 0;
  }
  return status == OK ? settle(step, at, of, now) : status;
}

/* Impact without collision (F. Genot & B. Brogliato, Eur. J. Mech. A 18, 1999) at a state whose forces have no
 * consistent mode: friction pulls stiff surfaces into each other without bound, until slips change. Its impulses are
 * the limits Lambda of h f for h -> 0, f the forces of a time step of J. J. Moreau's (CISM 302, 1988), with
 * r + h (b + W f) for the rates after it. They vanish where forces are bounded, else energy decreases: normal rates
 * with impulses are 0 and friction opposes the slip after it, so that
 * T+ - T- = Lambda r+ - Lambda W Lambda / 2 < 0. Returns whether there are any. */
static int jump(const event_step *step, event_sample *at, contact_terms *of, contact_change *now)
{
  contact_problem in = {.of = of, .lifts = 1};
  contact_mode mode[EVENT_CONTACTS];
  real right[CONTACT_ROWS], after[CONTACT_ROWS], impulse[CONTACT_ROWS] = {0.0};
  real speed = 0.0, approach = 0.0, largest = 0.0;
  int closed[EVENT_CONTACTS], first = -1;
  const int none[EVENT_CONTACTS] = {0};
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const int normal = CONTACTS[k].normal, slips = CONTACTS[k].slips;
    allow_modes(&in, k, now, step->watch->fastest[k]);
    closed[k] = is_met(of, now, none, k) || (normal >= 0 && !in.is_free[k]); /* also one that separates */
    in.is_free[k] &= !closed[k];
    in.begins[k] = in.limit[k] = 0;
    in.rests[k] = !in.is_free[k] && slips > 0;
    if (!in.is_free[k])
      in.role[k] = in.rests[k] ? CONTACT_STICKS : CONTACT_SLIPS;
    if (closed[k])
      approach = fmax(approach, -of->second[normal]);
    if (closed[k] && slips > 0)
      speed = fmax(speed, length_of(of->rate + CONTACTS[k].tangential, slips));
  }
  if (!(speed > 0.0 && approach > 0.0))
    return 0;
  const real h = CONTACT_AHEAD * speed / approach;
  for (int r = 0; r < CONTACT_ROWS; r++)
    right[r] = of->second[r] + of->rate[r] / h;
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const int normal = CONTACTS[k].normal;
    if (closed[k] && of->rate[normal] <= CONTACT_ROUNDING * of->speed[normal])
      right[normal] = of->second[normal];
  }
  in.right = right;
  if (!relax_modes(&in, impulse, mode) || !is_consistent(&in, mode, impulse, after))
    return 0;
  for (int r = 0; r < CONTACT_ROWS; r++)
    impulse[r] *= h;
  if (!impulses_of(of, none, closed, CONTACT_PLASTIC, of->rate, impulse))
    return 0;
  if (gain_of(of, impulse) > CONTACT_GAIN)
    return 0;
  for (int k = 0; k < EVENT_CONTACTS; k++)
    if (closed[k] && in.rests[k] && impulse[CONTACTS[k].normal] > largest) {
      largest = impulse[CONTACTS[k].normal];
      first = k;
    }
  if (first < 0 || collide(step, at, of, closed, impulse, now) != OK)
    return 0;
  if (!step->watch->jumps) {
    step->watch->jumps = first + 1;
    step->watch->jumped = at->t;
  }
  step->watch->refusal = 0;
  return 1;
}
