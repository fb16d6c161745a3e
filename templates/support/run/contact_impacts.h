#include "contact_modes.h"

/* Impacts of contacts with friction (C. Glocker & F. Pfeiffer, Nonlinear Dyn. 7, 1995). */
enum {
  CONTACT_IMPACTS = 100 /* of a contact in a corner */
};

#define CONTACT_RESIDUALS 16.0 /* residuals of its located zero below which a rebound ends */
#define CONTACT_AHEAD 1e-5 /* time step of an impact without collision, relative to that in which a slip would stop */
#define CONTACT_GAIN 1e-9 /* part of the work of an impact by which energy may grow */

/* Poses the problem with b = `rates` + h times the second rates: of impulses without these, else those of a step of
 * length h. Friction without gap is a force. */
static void pose_impulses(const contact_terms *of, const real *rates, real h, cone_problem *in)
{
  memset(in, 0, sizeof *in);
  in->W = of->W;
  for (int r = 0; r < CONTACT_ROWS; r++) {
    in->b[r] = rates[r] + (h > 0.0 ? h * of->second[r] : 0.0);
    in->terms[r] = of->speed[r];
  }
  for (int k = 0; k < EVENT_CONTACTS; k++)
    in->mu[k] = of->coefficient[3 * k] * (CONTACTS[k].normal < 0 ? h : 1.0);
}

/* Impulses of contacts that take part with given rates, of some with restitutions e (elastic, NULL: none), from the
 * impulses given; 0 if there are none. */
static int impulses_of(const contact_terms *of, const int *takes_part, const int *elastic, const real *rate,
    real *impulse)
{
  cone_problem in;
  pose_impulses(of, rate, 0.0, &in);
  memcpy(in.f, impulse, sizeof in.f);
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    in.takes_part[k] = takes_part[k];
    if (elastic && elastic[k] && CONTACTS[k].normal >= 0)
      in.b[CONTACTS[k].normal] *= 1.0 + of->coefficient[3 * k + 2];
  }
  const int solved = solve_cone(&in);
  memcpy(impulse, in.f, sizeof in.f);
  return solved;
}

/* Kinetic energy that impulses create from given rates, sum of f (u(before) + u(after)) / 2, and its size in *size. */
static real energy_of(const contact_terms *of, const real *rate, const real *impulse, real *size)
{
  real energy = 0.0, work = 0.0;
  for (int r = 0; r < CONTACT_ROWS; r++) {
    energy += 0.5 * impulse[r] * (rate[r] + rate_after(of, rate, impulse, r));
    work += impulse[r] * rate[r];
  }
  *size = fabs(work);
  return energy;
}

/* Part s of the difference of impulses with and without restitution, the largest in [0, 1] that creates no energy, a
 * quadratic function of s, not positive for s = 0: Newton's law with friction may create some (Kane's paradox). */
static real restitution_part(const contact_terms *of, const real *rate, const real *plastic, const real *elastic)
{
  const real still[CONTACT_ROWS] = {0.0};
  real moved[CONTACT_ROWS], size, bend, slope = 0.0;
  for (int r = 0; r < CONTACT_ROWS; r++)
    moved[r] = elastic[r] - plastic[r];
  bend = energy_of(of, still, moved, &size);
  for (int r = 0; r < CONTACT_ROWS; r++)
    slope += moved[r] * rate_after(of, rate, plastic, r);
  const real least = fmin(energy_of(of, rate, plastic, &size), 0.0);
  const real root = sqrt(fmax(slope * slope - 4.0 * bend * least, 0.0)); /* without cancellation */
  const real part = slope > 0.0 ? -2.0 * least / (slope + root) : (root - slope) / (2.0 * bend);
  return fmin(fmax(part, 0.0), 1.0);
}

/* Impulses by Newton's law of restitution, v = v_c + s (v_e - v_c), v_c without restitution: s = 1 unless that creates
 * energy. */
static int restitute(const event_step *step, const contact_terms *of, const int *takes_part, const int *meets,
    const real *rate, real *impulse)
{
  real plastic[CONTACT_ROWS], size;
  if (!impulses_of(of, takes_part, meets, rate, impulse))
    return 0;
  if (energy_of(of, rate, impulse, &size) <= CONTACT_GAIN * size)
    return 1;
  memcpy(plastic, impulse, sizeof plastic);
  if (!impulses_of(of, takes_part, NULL, rate, plastic))
    return 0;
  const real part = restitution_part(of, rate, plastic, impulse);
  for (int r = 0; r < CONTACT_ROWS; r++)
    impulse[r] = plastic[r] + part * (impulse[r] - plastic[r]);
  step->watch->restitutes_less = 1;
  return 1;
}

/* Adds to impulses those of the rows of contacts that approach, one after another, until none does: simultaneous ones
 * with those that touch and do not separate, all with closed ones and with those of e = 0, in blocks that W connects.
 * Without friction Newton's law creates no energy: T+ - T- = sum of (1 - e) Lambda v_n- / 2. Where they do not end, as
 * in a corner, they accumulate and their rates vanish: the limit is one without restitution. */
static int find_impulses(const event_step *step, const contact_terms *of, const int *approaches, const int *closed,
    real *total)
{
  for (int round = 0; round <= CONTACT_IMPACTS * EVENT_CONTACTS; round++) {
    const int last = round == CONTACT_IMPACTS * EVENT_CONTACTS;
    real rate[CONTACT_ROWS];
    int meets[EVENT_CONTACTS], may_act[EVENT_CONTACTS], acted[EVENT_CONTACTS] = {0}, first = -1;
    for (int r = 0; r < CONTACT_ROWS; r++)
      rate[r] = rate_after(of, of->rate, total, r);
    for (int k = EVENT_CONTACTS - 1; k >= 0; k--) {
      const int normal = CONTACTS[k].normal;
      if (approaches[k] && normal >= 0 && rate[normal] < -CONTACT_ROUNDING * of->speed[normal])
        first = k;
    }
    if (first < 0)
      return OK;
    step->watch->corner_ends |= last;
    for (int k = 0; k < EVENT_CONTACTS; k++) {
      const int normal = CONTACTS[k].normal, impacts = CONTACTS[k].impacts;
      const int together = impacts == CONTACT_SIMULTANEOUS && impacts == CONTACTS[first].impacts && approaches[k];
      meets[k] = k == first || (together && rate[normal] <= CONTACT_ROUNDING * of->speed[normal]) ||
          (last && approaches[k]);
      may_act[k] = meets[k] || closed[k] || (approaches[k] && of->coefficient[3 * k + 2] == 0.0);
    }
    for (int k = first; k < EVENT_CONTACTS; k++) {
      real impulse[CONTACT_ROWS] = {0.0};
      int takes_part[EVENT_CONTACTS] = {0};
      if (!meets[k] || acted[k])
        continue;
      cone_connect(CONTACTS, EVENT_CONTACTS, of->W, may_act, k, takes_part);
      if (!restitute(step, of, takes_part, last ? NULL : meets, rate, impulse))
        return refuse(step, CONTACT_WITHOUT_IMPULSE, k, 0.0);
      for (int r = 0; r < CONTACT_ROWS; r++)
        total[r] += impulse[r];
      for (int i = 0; i < EVENT_CONTACTS; i++)
        acted[i] |= takes_part[i];
    }
  }
  return OK;
}

/* Whether the height w^2 / (2 g'') of a rebound is of the size of rounding, or of the residuals of the located zeros of
 * the contacts that meet, which a projection moves; of a gap that moves, of that of the search, which sees no rounding
 * of time. g'' contains the forces of other contacts before the impact: in free fall joints have none without them. */
static int is_low(const event_step *step, const contact_terms *of, const real *force, real residual, int k)
{
  const int row = CONTACTS[k].normal;
  if (row < 0)
    return 0; /* friction alone has no gap */
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

/* Impulses of all contacts that meet at a state after those of others, and which contacts touch and rest afterwards. */
static int collide(const event_step *step, event_sample *at, contact_terms *of, const int *closed, const real *others,
    contact_change *now)
{
  const contact_terms before = *of;
  contact_mode present[EVENT_CONTACTS];
  real impulse[CONTACT_ROWS], force[CONTACT_ROWS], residual = 0.0;
  int approaches[EVENT_CONTACTS], status;
  forces_at(at->t, at->q, at->p, step->own, present, force, step->workspace);
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const int normal = CONTACTS[k].normal;
    approaches[k] = is_met(of, now, closed, k);
    residual = fmax(residual, approaches[k] ? fabs(of->value[normal]) : 0.0);
  }
  memcpy(impulse, others, sizeof impulse);
  status = find_impulses(step, of, approaches, closed, impulse);
  if (status == OK)
    status = push(step, at, of, impulse);
  for (int k = 0; status == OK && k < EVENT_CONTACTS; k++) {
    const int normal = CONTACTS[k].normal, slip = CONTACTS[k].tangential, slips = CONTACTS[k].slips;
    if (slips > 0)
      now->rests[k] = !now->begins[k] && length_of(of->rate + slip, slips) <= CONTACT_ROUNDING * before.speed[slip];
    if (normal < 0 || !(approaches[k] || closed[k]))
      continue;
    if (impulse[normal] > 0.0)
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
 * T+ - T- = Lambda r+ - Lambda W Lambda / 2 < 0. The step is so long that rates change by more than their rounding.
 * Returns whether there are any. */
static int jump(const event_step *step, event_sample *at, contact_terms *of, contact_change *now)
{
  cone_problem in;
  real rate[CONTACT_ROWS], speed = 0.0, approach = 0.0, rounding = 0.0, largest = 0.0, size;
  int closed[EVENT_CONTACTS], first = -1;
  const int none[EVENT_CONTACTS] = {0};
  memcpy(rate, of->rate, sizeof rate);
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const int normal = CONTACTS[k].normal, slips = CONTACTS[k].slips;
    closed[k] = is_met(of, now, none, k) || (normal >= 0 && !is_open(of, now, k)); /* also one that separates */
    if (closed[k] && rate[normal] <= CONTACT_ROUNDING * of->speed[normal])
      rate[normal] = 0.0;
    if (closed[k]) {
      approach = fmax(approach, -of->second[normal]);
      rounding = fmax(rounding, CONTACT_ROUNDING * of->speed[normal]);
    }
    if (closed[k] && slips > 0)
      speed = fmax(speed, length_of(of->rate + CONTACTS[k].tangential, slips));
  }
  if (!(speed > 0.0 && approach > 0.0))
    return 0;
  pose_impulses(of, rate, fmax(CONTACT_AHEAD * speed, CONTACT_RESIDUALS * rounding) / approach, &in);
  for (int k = 0; k < EVENT_CONTACTS; k++)
    in.takes_part[k] = closed[k] || (CONTACTS[k].normal < 0 && !is_open(of, now, k));
  if (!solve_cone(&in) || !impulses_of(of, closed, NULL, of->rate, in.f) ||
      energy_of(of, of->rate, in.f, &size) > CONTACT_GAIN * size)
    return 0;
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const int normal = CONTACTS[k].normal;
    if (closed[k] && normal >= 0 && CONTACTS[k].slips > 0 && in.f[normal] > largest) {
      largest = in.f[normal];
      first = k;
    }
  }
  if (first < 0 || collide(step, at, of, closed, in.f, now) != OK)
    return 0;
  if (!step->watch->jumps) {
    step->watch->jumps = first + 1;
    step->watch->jumped = at->t;
  }
  step->watch->refusal = 0;
  return 1;
}
