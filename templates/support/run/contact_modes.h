#include "contact_forces.h"

/* Choice of modes: those of the contact problem (cone.h) for second rates, read from the rates of its solution. */
enum {
  CONTACT_OTHERS = 256 /* modes that are compared with those of the solution */
};

#define CONTACT_BEGIN 1e-4 /* first part of a slip in space, relative to a step: longer than that of rounding */
#define CONTACT_APART 1e-5 /* part of their size by which the rates of two motions differ */
#define CONTACT_ASIDE 1e-9 /* largest angle between friction and slip in space */

/* What gaps and slips at a state allow: open by its gap (is_free); slip that rests, or begins (is_slow), with 1 or -1
 * if it slips after it stuck. role: whether it may be closed, and its friction any (sticks) or in its direction. */
typedef struct {
  int is_free[EVENT_CONTACTS], is_slow[EVENT_CONTACTS], begins[EVENT_CONTACTS], any_begins;
  int lifts; /* contacts without force are open, else closed */
  contact_mode role[EVENT_CONTACTS];
} contact_roles;

/* Whether a contact is open by its gap at a state, or leaves. */
static int is_open(const contact_terms *of, const contact_change *now, int k)
{
  const int row = CONTACTS[k].normal;
  return of->absent[k] || now->leaves[k] ||
      (row >= 0 && !now->touches[k] &&
          (of->value[row] > CONTACT_ROUNDING * of->size[row] || of->rate[row] > CONTACT_ROUNDING * of->speed[row]));
}

/* Sets what the gap and the slip of a contact at a state allow; fastest: its slip so far. */
static void allow_modes(const contact_terms *of, int k, const contact_change *now, real fastest, contact_roles *in)
{
  const contact_places *at = CONTACTS + k;
  const real *const w = of->rate + at->tangential;
  in->is_free[k] = is_open(of, now, k);
  in->is_slow[k] = 0;
  in->begins[k] = now->begins[k];
  in->any_begins |= now->begins[k] != 0;
  in->role[k] = in->is_free[k] ? CONTACT_IS_OPEN : CONTACT_SLIPS;
  if (in->is_free[k] || at->slips == 0)
    return;
  in->is_slow[k] = now->begins[k] || now->rests[k] || length_of(w, at->slips) <= CONTACT_ROUNDING * fastest;
  if (in->is_slow[k])
    in->role[k] = CONTACT_STICKS;
  for (int i = 0; i < at->slips && !in->is_slow[k]; i++)
    in->role[k].direction[i] = w[i] / length_of(w, at->slips);
}

/* Effect of rounding on the second rate of a row, by its terms and the sizes of those in all rows on whose forces it
 * depends: in free fall those of joints cancel. */
static real rounding_at_row(const contact_terms *of, const real *after, int row)
{
  real size = of->second_terms[row];
  for (int r = 0; r < CONTACT_ROWS; r++)
    if (of->W[row * CONTACT_ROWS + r] != 0.0)
      size = fmax(size, fmax(fabs(of->second[r]), fabs(after[r])));
  return CONTACT_ROUNDING * size;
}

/* Whether a contact satisfies the conditions of its mode by forces and second rates. */
static int satisfies(const contact_terms *of, const contact_roles *in, int k, contact_mode mode, const real *force,
    const real *after)
{
  const int normal = CONTACTS[k].normal, slip = CONTACTS[k].tangential, slips = CONTACTS[k].slips;
  const real small = rounding_at_row(of, after, normal < 0 ? slip : normal), *const d = mode.direction;
  real begin = 0.0, moves = 0.0;
  if (in->is_free[k])
    return 1;
  const real load = normal < 0 ? 1.0 : force[normal] * of->W[normal * (CONTACT_ROWS + 1)];
  if (mode.closed ? !(load > (in->lifts ? small : -small)) : after[normal] < -small)
    return 0;
  if (!mode.closed || !in->is_slow[k])
    return 1;
  for (int i = 0; i < slips; i++) {
    begin += d[i] * after[slip + i];
    moves = fmax(moves, fabs(after[slip + i]));
  }
  const real aside = slips == 2 ? d[0] * after[slip + 1] - d[1] * after[slip] : 0.0;
  const real limit = friction_limit(of, k, mode.sticks || mode.held, force);
  const real beyond = (length_of(force + slip, slips) - limit) * of->W[slip * (CONTACT_ROWS + 1)];
  if (mode.sticks || mode.held)
    return beyond <= small && (mode.sticks || moves <= small);
  return begin >= -small && fabs(aside) <= fmax(small, CONTACT_ASIDE * begin);
}

/* Whether modes satisfy the conditions with the forces in them; these, and the second rates. */
static int is_consistent(const contact_terms *of, const contact_roles *in, const contact_mode *mode, real *force,
    real *after)
{
  int holds = solve_contacts(of, mode, of->second, force, after, NULL) <= CONTACT_OUTSIDE;
  for (int k = 0; k < EVENT_CONTACTS && holds; k++)
    holds = satisfies(of, in, k, mode[k], force, after);
  return holds;
}

/* Number of independent rows that a mode imposes. */
static int rank_of(const contact_terms *of, const contact_mode *mode)
{
  real force[CONTACT_ROWS], after[CONTACT_ROWS];
  int imposed[CONTACT_ROWS] = {0}, rank = 0;
  solve_contacts(of, mode, of->second, force, after, imposed);
  for (int r = 0; r < CONTACT_ROWS; r++)
    rank += imposed[r];
  return rank;
}

/* Marks the contacts whose rows the imposed ones determine: open ones carry no load, and friction of slips that begin
 * keeps its ratio to the normal force. */
static void hold_contacts(const contact_terms *of, const contact_roles *in, const cone_problem *solved,
    contact_mode *mode)
{
  const int rank = rank_of(of, mode);
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const contact_mode now = mode[k];
    const real limit = friction_limit(of, k, 0, solved->f);
    if (now.closed ? now.sticks || !solved->mode[k].sticks : in->is_free[k])
      continue;
    mode[k] = now.closed ? CONTACT_STICKS : CONTACT_SLIPS;
    const int held = rank_of(of, mode) == rank;
    mode[k] = now;
    mode[k].held = held;
    for (int i = 0; i < CONTACTS[k].slips && held && now.closed && limit > 0.0; i++)
      mode[k].direction[i] = -solved->f[CONTACTS[k].tangential + i] / limit;
  }
}

/* Opens a contact, if other forces give the same rates of the imposed rows but not of all, as of several supports that
 * slide in different directions: the first of those that carry no load along such forces. Whether there is one. */
static int unload(const contact_terms *of, const contact_mode *mode, const real *force, contact_roles *in)
{
  contact_unknowns unknown;
  const real still[CONTACT_ROWS] = {0.0};
  real line[CONTACT_ROWS][CONTACT_ROWS + 1], none[CONTACT_ROWS], least = INFINITY;
  int independent[CONTACT_ROWS], first = -1;
  find_unknowns(of, mode, &unknown, none);
  if (!reduce_equations(of, &unknown, of->second, none, line, independent))
    return 0;
  for (int d = 0; d < unknown.count && first < 0; d++) {
    real moved[CONTACT_ROWS] = {0.0};
    for (int i = 0; i < unknown.count && !independent[d]; i++)
      for (int r = 0; r < CONTACT_ROWS; r++)
        moved[r] += unknown.column[i][r] * (independent[i] ? -line[i][d] / line[i][i] : i == d);
    for (int k = 0; k < EVENT_CONTACTS && discord_of(of, still, moved, still, still, moved) > CONTACT_ROUNDING; k++) {
      const int normal = CONTACTS[k].normal;
      if (normal < 0 || !mode[k].closed || !(fabs(force[normal]) < least * fabs(moved[normal])))
        continue;
      least = fabs(force[normal] / moved[normal]);
      first = k;
    }
  }
  if (first >= 0)
    in->role[first] = CONTACT_IS_OPEN;
  return first >= 0;
}

/* Modes that a contact may have beside the best one, of which the first ones stick: only those that static friction
 * does not distinguish from it. Slips in space at rest have no other direction. Returns their number. */
static int list_modes(const contact_terms *of, const contact_roles *in, int k, const contact_mode *best,
    contact_mode *mode)
{
  const real *const friction = of->coefficient + 3 * k;
  const int line = CONTACTS[k].slips == 1 && in->role[k].sticks && friction[0] == friction[1];
  int count = 0;
  if (!line || !in->begins[k])
    mode[count++] = line || !best[k].closed ? in->role[k] : best[k];
  for (int way = 1; line && way >= -1; way -= 2) {
    mode[count] = CONTACT_SLIPS;
    mode[count++].direction[0] = way;
  }
  if (!in->is_free[k] && CONTACTS[k].normal >= 0)
    mode[count++] = CONTACT_IS_OPEN;
  return count;
}

/* First consistent modes beside the best ones, of which given rates, if there are any, differ from theirs; 0 if there
 * are none, or too many to try. */
static int find_others(const contact_terms *of, const contact_roles *in, const contact_mode *best, const real *rates,
    contact_mode *mode)
{
  real force[CONTACT_ROWS], after[CONTACT_ROWS], size = 0.0;
  contact_mode list[EVENT_CONTACTS][4];
  int count[EVENT_CONTACTS], total = 1;
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    count[k] = list_modes(of, in, k, best, list[k]);
    total *= total <= CONTACT_OTHERS ? count[k] : 1;
  }
  for (int r = 0; r < CONTACT_ROWS; r++)
    size = fmax(size, fabs(of->second[r]));
  for (int number = 0; total <= CONTACT_OTHERS && number < total; number++) {
    int differs = !rates;
    for (int k = 0, rest = number; k < EVENT_CONTACTS; rest /= count[k++])
      mode[k] = list[k][rest % count[k]];
    if (!is_consistent(of, in, mode, force, after))
      continue;
    for (int r = 0; r < CONTACT_ROWS && rates; r++)
      differs |= fabs(after[r] - rates[r]) > CONTACT_APART * fmax(size, fabs(after[r])) + rounding_at_row(of, after, r);
    if (differs)
      return 1;
  }
  return 0;
}

/* Poses the problem of second rates for the roles. */
static void pose_forces(const contact_terms *of, const contact_roles *in, const real *force, cone_problem *problem)
{
  memset(problem, 0, sizeof *problem);
  problem->W = of->W;
  memcpy(problem->b, of->second, sizeof problem->b);
  memcpy(problem->terms, of->second_terms, sizeof problem->terms);
  memcpy(problem->f, force, sizeof problem->f);
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    problem->takes_part[k] = in->role[k].closed;
    problem->rests[k] = in->is_slow[k] && !in->begins[k];
    problem->mu[k] = of->coefficient[3 * k];
    problem->mu_static[k] = of->coefficient[3 * k + 1];
    memcpy(problem->given[k], in->role[k].direction, sizeof problem->given[k]);
  }
}

/* Mode of a contact by the rates of a solution: closed while that of its gap is 0, and it pushes if others lift; it
 * sticks while that of its slip is. Slips that begin have no rate yet: those with friction at its limit, which of
 * redundant contacts reach it together (theorems of limit analysis). */
static contact_mode mode_by_rates(const contact_terms *of, const contact_roles *in, const cone_problem *solved, int k,
    int lifts)
{
  const cone_mode mode = solved->mode[k];
  const int slip = CONTACTS[k].tangential, slips = CONTACTS[k].slips;
  contact_mode slides = CONTACT_SLIPS;
  if (!in->role[k].closed || !(lifts ? mode.pushes : mode.is_closed))
    return CONTACT_IS_OPEN;
  const int may_begin = in->begins[k] || (in->any_begins && solved->mu[k] == solved->mu_static[k]);
  const real least = (1.0 - CONTACT_OUTSIDE) * friction_limit(of, k, 0, solved->f);
  if (!in->role[k].sticks || (mode.sticks && !(may_begin && length_of(solved->f + slip, slips) >= least)))
    return in->role[k];
  memcpy(slides.direction, mode.direction, sizeof slides.direction);
  return slides;
}

/* Consistent modes: of several those in which all is closed and sticks, else by the rates of the contact problem; where
 * forces in them pull, as of rows that nearly depend, those of contacts that push, of fewer if forces do not determine
 * the rates, else others. Returns whether the problem is solved. */
static int solve_modes(const contact_terms *of, contact_roles *in, real *force, contact_mode *mode)
{
  cone_problem problem;
  contact_mode last[EVENT_CONTACTS];
  real exact[CONTACT_ROWS], after[CONTACT_ROWS];
  memcpy(mode, in->role, sizeof in->role);
  if (!in->any_begins && is_consistent(of, in, mode, exact, after))
    return 1;
  do {
    pose_forces(of, in, force, &problem);
    if (!solve_cone(&problem))
      return 0;
    memcpy(force, problem.f, sizeof problem.f);
    for (int pushes = in->lifts; pushes <= 1; pushes++) {
      for (int k = 0; k < EVENT_CONTACTS; k++)
        mode[k] = mode_by_rates(of, in, &problem, k, pushes);
      hold_contacts(of, in, &problem, mode);
      if (is_consistent(of, in, mode, exact, after))
        return 1;
    }
  } while (unload(of, mode, force, in));
  memcpy(last, mode, sizeof last);
  if (!find_others(of, in, last, NULL, mode))
    memcpy(mode, last, sizeof last);
  return 1;
}

/* Notes why no motion is possible; contact k, or all. */
static int refuse(const event_step *step, int reason, int k, real value)
{
  step->watch->refusal = reason;
  step->watch->refused = k + 1;
  step->watch->behind = value;
  return NOT_CONVERGED;
}

/* Why a coefficient is impossible, 0 if none is: friction is negative or undefined, less static than sliding at rest,
 * or the restitution of a contact that meets others is not in [0, 1]; that number. */
static int impossible_reason(const contact_terms *of, int k, int rests, int meets, real *number)
{
  const real mu = of->coefficient[3 * k], held = of->coefficient[3 * k + 1], e = of->coefficient[3 * k + 2];
  const real *const noise = of->noise + 3 * k;
  *number = e;
  if (!(mu >= 0.0)) {
    *number = mu;
    return CONTACT_IMPOSSIBLE;
  }
  if (rests && !(held >= (1.0 - CONTACT_ROUNDING) * mu - noise[0] - noise[1])) {
    *number = held;
    return CONTACT_WEAKENS;
  }
  return meets && !(e >= 0.0 && e <= 1.0 + noise[2]) ? CONTACT_REPELS : 0;
}

/* Whether the direction (ahead.w) w + start of a slip in space is that of its second term. */
static int keeps_direction(const real *start, const real *w)
{
  return length_of(start, 2) > length_of(w, 2) * length_of(w, 2);
}

/* Sets what the state allows a contact, and whether a slip keeps its `present` direction: friction would jump to that
 * of the rate. Fails where a coefficient is impossible. */
static int allow_present(const event_step *step, const contact_terms *of, const contact_change *now,
    const contact_mode *present, int k, contact_roles *in, int *directed)
{
  const real *const start = step->watch->mode + CONTACTS[k].direction + 1, *const d = present->direction;
  const int slip = CONTACTS[k].tangential, slips = CONTACTS[k].slips;
  real impossible = 0.0;
  allow_modes(of, k, now, step->watch->fastest[k], in);
  const int is_still = in->is_slow[k] && length_of(of->rate + slip, slips) <= CONTACT_ROUNDING * of->speed[slip];
  const int reason = in->is_free[k] ? 0 : impossible_reason(of, k, is_still, 0, &impossible);
  if (reason)
    return refuse(step, reason, k, impossible);
  *directed = slips == 2 && in->role[k].closed && !in->is_slow[k] && start[-1] != 0.0 && !present->held &&
      keeps_direction(start, of->rate + slip);
  for (int i = 0; *directed && i < 2; i++)
    in->role[k].direction[i] = d[i] / length_of(d, 2);
  return OK;
}

/* The mode of a contact with the rows that are imposed, of which others determine the rest, and its second rates. */
static contact_mode mode_by_rows(const contact_terms *of, contact_mode mode, int k, const int *imposed,
    const real *second)
{
  const int normal = CONTACTS[k].normal, slip = CONTACTS[k].tangential, all = (1 << CONTACTS[k].slips) - 1;
  int sticks = 0;
  for (int i = 0; i < CONTACTS[k].slips && mode.sticks; i++)
    sticks |= imposed[slip + i] << i;
  if (!mode.closed && normal >= 0 && second[normal] > rounding_at_row(of, second, normal))
    mode.held = 0; /* leaves, as straight legs bend */
  if (mode.closed && normal >= 0 && !imposed[normal])
    mode.held |= CONTACT_LOADED;
  if (mode.sticks && sticks != all)
    mode.held |= CONTACT_STUCK;
  mode.sticks = sticks;
  return mode;
}

/* Sets the consistent modes at a state that stick most, of redundant contacts those near given forces. */
static int choose_modes(const event_step *step, const contact_terms *of, const contact_change *now, real *force)
{
  contact_roles in = {.lifts = now->lifts};
  contact_mode present[EVENT_CONTACTS], best[EVENT_CONTACTS], other[EVENT_CONTACTS];
  real second[CONTACT_ROWS];
  int imposed[CONTACT_ROWS] = {0}, directed[EVENT_CONTACTS] = {0};
  modes_at(of, step->watch->mode, present);
  for (int k = 0; k < EVENT_CONTACTS; k++)
    TRY(allow_present(step, of, now, present + k, k, &in, directed + k));
  if (!solve_modes(of, &in, force, best))
    return refuse(step, CONTACT_WITHOUT_MODE, -1, 0.0);
  solve_contacts(of, best, of->second, force, second, imposed);
  step->watch->ambiguous |= find_others(of, &in, best, second, other);
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const int slip = CONTACTS[k].tangential, is_slow = in.is_slow[k];
    real speed = slip < 0 ? 0.0 : of->speed[slip]; /* and that by forces that cancel */
    for (int j = 0; j < CONTACT_ROWS && slip >= 0; j++)
      speed += fabs(of->W[slip * CONTACT_ROWS + j] * force[j] * step->whole);
    const real *const w = is_slow || directed[k] || slip < 0 ? AT_REST : of->rate + slip;
    put_mode(CONTACTS + k, mode_by_rows(of, best[k], k, imposed, second), w, speed, step->watch->mode);
    if (is_slow)
      step->watch->fastest[k] = fmax(step->watch->fastest[k], speed);
    step->watch->part[k] = (is_slow ? CONTACT_BEGIN : 1.0) * fabs(step->whole);
  }
  put_modes(step->watch->mode, step->own);
  return OK;
}
