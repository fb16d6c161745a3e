#include "events.h"
#include "impacts.h"

/* Contacts: the modes of a run, which transitions change at their located times.
 *
 * With the rows r of all contacts (gaps g, slips w) the second rates are r'' = b + W f for the forces f of the rows,
 * W = G M^-1 G^T. In a mode forces are unknown at the gaps of closed contacts and at the slips of sticking ones, where
 * r'' = 0; sliding adds -mu d times the normal force at the slip. A mode is consistent if normal forces are >= 0, open
 * contacts have g'' >= 0, sticking ones |tau| <= mu_s lambda, and slip that begins w' d > 0. With friction none
 * (P. Painleve, C. R. Acad. Sci. 121, 1895; F. Genot & B. Brogliato, Eur. J. Mech. A 18, 1999) or several may be.
 * Impacts obey the same conditions for impulses and velocities (C. Glocker, Set-Valued Force Laws, 2001). Requires:
 * parts/contacts.c.jinja. */
enum {
  CONTACT_TRIALS = 8, /* of a relaxation, each of twice as many sweeps */
  CONTACT_SWEEPS = 50, /* over the forces of contacts */
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

#define CONTACT_ROUNDING 1e-10 /* part of their size below which gaps, rates and forces count as 0 */
#define CONTACT_SLOW 1e-6 /* part of its size below which the direction of a slip in space is kept */
#define CONTACT_BEGIN 1e-6 /* first part of a slip in space, relative to a step */
#define CONTACT_PART 0.2 /* longest parts relative to the times from its beginning and to its stop .. */
#define CONTACT_RELAXES 3.0 /* .. and to the relaxation of its direction, for which iterations on stages converge .. */
#define CONTACT_SHORT 3e-4 /* .. once that is longer than this part of a step */
#define CONTACT_PENETRATION 1e-9 /* part of its size by which a gap may be negative at a start */
#define CONTACT_MISSED 128.0 /* effects of rounding beyond which a negative gap shows a missed transition */
#define CONTACT_LOWEST 16.0 /* roundings of a gap below which a rebound ends */
#define CONTACT_RESIDUALS 16.0 /* residuals of its located zero below which a rebound ends */
#define CONTACT_TURN 0.866 /* cosine of an angle after which a direction is renewed */
#define CONTACT_ASIDE 1e-9 /* largest angle between friction and slip in space */
#define CONTACT_FAST 1e3 /* speed relative to that of a slip whose direction is kept */
#define CONTACT_COMPLIANCE 1e-3 /* of friction at the start of a relaxation */
#define CONTACT_DEPENDENT 1e-12 /* part of a column below which a pivot counts as 0 */
#define CONTACT_GAIN 1e-9 /* part of the work of an impact by which energy may grow */

/* What the modes of contacts do not allow, in watch->refusal. */
enum {
  CONTACT_PENETRATES = 1,
  CONTACT_WITHOUT_MODE, /* Painleve's paradox, or redundant contacts */
  CONTACT_WITHOUT_IMPULSE,
  CONTACT_IN_CORNER,
  CONTACT_IMPOSSIBLE /* coefficients */
};

/* A contact without gap is always closed; one without friction does not stick, and has direction 0. Slip in space that
 * begins has a direction to be found, 0 until then. Bit i of `sticks` imposes slip i. A contact is held where the rows
 * of others determine its own: open, it carries no load; closed, its friction is -mu d times the normal force at rest.
 * Of closed and sticking contacts a step imposes independent rows; `held` then has bits for those of others. */
typedef struct {
  int closed, sticks, held;
  real direction[2];
} contact_mode;

enum {
  CONTACT_HELD = 1,
  CONTACT_LOADED = 2, /* closed by others */
  CONTACT_STUCK = 4 /* sticks by others */
};

static const real AT_REST[2] = {0.0, 0.0};
static const contact_mode CONTACT_IS_OPEN = {0, 0, 0, {0.0, 0.0}};
static const contact_mode CONTACT_STICKS = {1, 3, 0, {0.0, 0.0}};
static const contact_mode CONTACT_SLIPS[3] = {{1, 0, 0, {-1.0, 0.0}}, {1, 0, 0, {0.0, 0.0}}, {1, 0, 0, {1.0, 0.0}}};

/* Rows at a state: values and rates, second rates b, W and G by rows, coefficients (mu, mu_s, e; limits of friction
 * without gap), the sizes of the terms of values and rates, the rounding of values, and rates at rest. */
typedef struct {
  real numbers[CONTACT_NUMBERS];
  const real *value, *rate, *second, *W, *G, *coefficient;
  real size[CONTACT_ROWS], speed[CONTACT_ROWS], rounding[CONTACT_ROWS], drift[CONTACT_ROWS];
  int absent[EVENT_CONTACTS]; /* whether a condition of the contact fails, or the state is behind it */
} contact_terms;

/* Transitions that end a mode together, and their consequences: contacts that close, or whose conditions fail, slips
 * that stop, directions of slips that begin; contacts with g = g' = 0, and with w = 0. */
typedef struct {
  int closes[EVENT_CONTACTS], leaves[EVENT_CONTACTS], stops[EVENT_CONTACTS], begins[EVENT_CONTACTS];
  int touches[EVENT_CONTACTS], rests[EVENT_CONTACTS];
} contact_change;

static real length_of(const real *x, int count)
{
  return count < 2 ? fabs(x[0]) : hypot(x[0], x[1]);
}

/* Mode of a contact by its parameters; of a slip in space with the direction `ahead`. */
static contact_mode mode_of(const real *mode, int k)
{
  const contact_places *at = CONTACTS + k;
  const int held = (int)mode[at->held];
  const real *const slides = mode + at->direction;
  contact_mode now = {at->closed < 0 || mode[at->closed] != 0.0 || (held & CONTACT_LOADED), 0, held & CONTACT_HELD,
      {0.0, 0.0}};
  for (int i = 0; i < at->slips; i++) {
    now.sticks |= (mode[at->sticks + i] != 0.0 || (held & CONTACT_STUCK)) << i;
    now.direction[i] = slides[0];
    if (at->slips == 2)
      now.direction[i] *= now.held ? slides[1 + i] / fmax(length_of(slides + 1, 2), DBL_MIN) : slides[3 + i];
  }
  return now;
}

/* Sets the parameters of a mode. In the plane the direction of slip is one, d. In space it is that of (ahead.w) w +
 * start: smooth where w vanishes and slip stops, beyond which ahead.w < 0, with the direction `ahead` at an earlier
 * step; the second term keeps the direction of slow slips. */
static void put_mode(const contact_places *at, contact_mode mode, const real *w, real speed, real *modes)
{
  const int held = mode.held & CONTACT_HELD, slips = mode.closed && !mode.sticks && !(mode.held & CONTACT_STUCK);
  real *const slides = modes + at->direction;
  if (at->closed >= 0)
    modes[at->closed] = mode.closed && !(mode.held & CONTACT_LOADED);
  modes[at->held] = mode.held;
  for (int i = 0; i < at->slips; i++)
    modes[at->sticks + i] = mode.sticks >> i & 1;
  if (at->slips == 1)
    slides[0] = mode.direction[0];
  for (int i = 0; at->slips == 2 && i < 2; i++) {
    const real size = length_of(mode.direction, 2), slow = length_of(w, 2) > CONTACT_SLOW * speed ? 0.0 : pow(CONTACT_FAST * speed, 2.0);
    slides[0] = held ? size : slips;
    slides[1 + i] = (held && size > 0.0 ? pow(CONTACT_FAST * speed, 2.0) / size : slow) * mode.direction[i];
    slides[3 + i] = held ? 0.0 : mode.direction[i];
  }
}

/* Size of the terms of a row by positions. Of a rotation or a direction, on whose length it does not depend, that is
 * |G| |q| instead of a sum by components: of a quaternion twice the derivative by an angle. */
static real size_by_position(const real *G, const real *q)
{
  real sum = 0.0;
  for (int k = 0, i = 0; k < CONTACT_VECTORS; k++) {
    real gradient = 0.0, position = 0.0;
    for (const int next = i + CONTACT_VECTOR[k]; i < next; i++) {
      gradient = hypot(gradient, G[i]);
      position = hypot(position, q[i]);
    }
    sum += gradient * position;
  }
  return sum;
}

/* Evaluates the numbers of the rows at a state. */
static int rows_at(real t, const real *q, const real *p, const real *parameters, contact_terms *of, real *workspace)
{
  real idle[PARAMETERS], imposed[PARAMETERS], mode[EVENT_MODES];
  for (int k = 0; k < EVENT_MODES; k++)
    mode[k] = parameters[MODE_PLACE[k]];
  memcpy(idle, parameters, BYTES(PARAMETERS));
  memcpy(imposed, parameters, BYTES(PARAMETERS));
  for (int k = 0; k < EVENT_CONTACTS; k++)
    put_mode(CONTACTS + k, CONTACT_IS_OPEN, AT_REST, 0.0, mode);
  put_modes(mode, idle);
  for (int k = 0; k < EVENT_CONTACTS; k++)
    put_mode(CONTACTS + k, CONTACT_STICKS, AT_REST, 0.0, mode);
  put_modes(mode, imposed);
  of->value = of->numbers;
  of->rate = of->value + CONTACT_ROWS;
  of->second = of->rate + CONTACT_ROWS;
  of->W = of->second + CONTACT_ROWS;
  of->G = of->W + CONTACT_ROWS * CONTACT_ROWS;
  of->coefficient = of->G + CONTACT_ROWS * M;
  return NAME(contact_terms)(t, q, p, idle, imposed, of->numbers, workspace);
}

static int terms_at(const event_step *step, const event_sample *at, contact_terms *of)
{
  real *const v = step->memory + 3 * M, power = 0.0;
  const real duration = fabs(step->whole);
  int status = rows_at(at->t, at->q, at->p, step->own, of, step->workspace);
  if (status == OK)
    status = NAME(velocity)(at->t, at->q, at->p, step->own, v, step->workspace);
  for (int i = 0; i < M; i++)
    power += at->p[i] * v[i];
  for (int r = 0; r < CONTACT_ROWS; r++) {
    const real by_position = size_by_position(of->G + r * M, at->q);
    real by_velocity = 0.0;
    for (int i = 0; i < M; i++)
      by_velocity += of->G[r * M + i] * v[i];
    /* |G v| <= sqrt(G M^-1 G^T) sqrt(v^T M v), and the change of the rate in a step */
    of->speed[r] = sqrt(fabs(of->W[r * (CONTACT_ROWS + 1)] * power)) + fabs(of->rate[r] - by_velocity) +
        fabs(of->second[r]) * duration;
    of->drift[r] = fabs(of->rate[r] - by_velocity);
    of->rounding[r] = DBL_EPSILON * (by_position + fabs(at->t) * of->drift[r]);
    of->size[r] = by_position + of->speed[r] * duration;
  }
  memset(of->absent, 0, sizeof of->absent);
  for (int i = 0; status == OK && i < TRANSITIONS; i++) {
    const int event = FIRST_TRANSITION + i, k = TRANSITION[i][0], row = CONTACTS[k].normal;
    int exists;
    if (TRANSITION[i][1] != CONTACT_CLOSES || !IS_CONDITIONAL[event])
      continue;
    status = conditions(EVENT_FIRST[event], at->t, at->q, at->p, step->parameters, &exists, step->workspace);
    of->absent[k] = !exists || of->value[row] < -CONTACT_PENETRATION * of->size[row];
  }
  return status;
}

/* Reduces the rows (A, b) by elimination with the pivots on the diagonal that are independent of those before but for
 * rounding, so that their rows and columns are. Returns the number of others. */
static int eliminate(real (*line)[CONTACT_ROWS + 1], int count, int *independent)
{
  int others = 0;
  for (int i = 0; i < count; i++) {
    real size = 0.0;
    for (int r = 0; r < count; r++)
      size = fmax(size, fabs(line[r][i]));
    independent[i] = fabs(line[i][i]) > CONTACT_DEPENDENT * size;
    others += !independent[i];
    for (int r = 0; r < count && independent[i]; r++) {
      const real factor = line[r][i] / line[i][i];
      for (int j = i; r != i && j <= count; j++)
        line[r][j] -= factor * line[i][j];
    }
  }
  return others;
}

/* Moves a solution of dependent columns along their null vectors to that of the least sum of weight x^2. */
static void reduce_norm(real (*line)[CONTACT_ROWS + 1], int count, const int *independent, const real *weight, real *x)
{
  real null[CONTACT_ROWS][CONTACT_ROWS];
  int found = 0;
  for (int d = 0; d < count; d++) {
    real *const n = null[found], norm = 0.0, along = 0.0;
    if (independent[d])
      continue;
    for (int i = 0; i < count; i++)
      n[i] = independent[i] ? -line[i][d] / line[i][i] : i == d;
    for (int e = 0; e < found; e++) {
      real part = 0.0;
      for (int i = 0; i < count; i++)
        part += weight[i] * n[i] * null[e][i];
      for (int i = 0; i < count; i++)
        n[i] -= part * null[e][i];
    }
    for (int i = 0; i < count; i++) {
      norm += weight[i] * n[i] * n[i];
      along += weight[i] * n[i] * x[i];
    }
    for (int i = 0; i < count; i++) {
      x[i] -= along / norm * n[i];
      n[i] /= sqrt(norm);
    }
    found++;
  }
}

/* Rate of a row, right + W f. */
static real rate_after(const contact_terms *of, const real *right, const real *force, int row)
{
  real rate = right[row];
  for (int j = 0; j < CONTACT_ROWS; j++)
    rate += of->W[row * CONTACT_ROWS + j] * force[j];
  return rate;
}

/* Largest friction force or impulse of a contact, by its coefficient of sliding (0) or sticking (1). */
static real friction_limit(const contact_terms *of, int k, int which, const real *force)
{
  return of->coefficient[3 * k + which] * (CONTACTS[k].normal < 0 ? 1.0 : force[CONTACTS[k].normal]);
}

/* Solves for the forces of the rows in given modes with after = right + W f = 0 in imposed rows, those of least norm,
 * friction relative to its limit, if these are dependent; returns 0 if they contradict each other, or such forces
 * differ in the rates. If `imposed` is not NULL, it becomes 1 for rows to impose, which are independent. */
static int solve_contacts(const contact_terms *of, const contact_mode *mode, const real *right, real *force,
    real *after, int *imposed)
{
  real matrix[CONTACT_ROWS][CONTACT_ROWS + 1], column[CONTACT_ROWS][CONTACT_ROWS]; /* forces by unknowns */
  real x[CONTACT_ROWS], least[CONTACT_ROWS], still[CONTACT_ROWS] = {0.0}, moved[CONTACT_ROWS] = {0.0};
  real weight[CONTACT_ROWS], load = DBL_MIN;
  int row[CONTACT_ROWS], independent[CONTACT_ROWS], owner[CONTACT_ROWS], count = 0, dependent;
  memset(force, 0, BYTES(CONTACT_ROWS));
  memset(column, 0, sizeof column);
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const contact_places *at = CONTACTS + k;
    real *const sliding = at->normal < 0 ? force : column[count];
    for (int i = 0; i < at->slips; i++)
      sliding[at->tangential + i] = -of->coefficient[3 * k] * mode[k].direction[i];
    if (at->normal >= 0 && mode[k].closed) {
      row[count] = at->normal;
      owner[count] = -1;
      column[count++][at->normal] = 1.0;
    }
    for (int i = 0; i < at->slips; i++)
      if (mode[k].sticks >> i & 1) {
        row[count] = at->tangential + i;
        owner[count] = k;
        column[count++][at->tangential + i] = 1.0;
      }
  }
  for (int i = 0; i < count; i++) {
    const real *W = of->W + row[i] * CONTACT_ROWS;
    for (int j = 0; j < count; j++)
      matrix[i][j] = 0.0;
    for (int r = 0; r < CONTACT_ROWS; r++)
      for (int j = 0; j < count; j++)
        matrix[i][j] += W[r] * column[j][r];
    matrix[i][count] = -rate_after(of, right, force, row[i]);
  }
  dependent = eliminate(matrix, count, independent);
  for (int i = 0; i < count; i++) {
    least[i] = x[i] = independent[i] ? matrix[i][count] / matrix[i][i] : 0.0;
    weight[i] = 1.0;
  }
  for (int pass = 0; pass < 2 && dependent; pass++) {
    reduce_norm(matrix, count, independent, weight, least);
    for (int i = 0; i < count; i++) {
      moved[row[i]] = least[i];
      load = fmax(load, fabs(least[i]));
    }
    for (int i = 0; i < count; i++) {
      const real limit = owner[i] < 0 ? load : friction_limit(of, owner[i], 1, moved);
      weight[i] = 1.0 / fmax(limit, CONTACT_SLOW * load);
    }
  }
  memset(moved, 0, sizeof moved);
  for (int i = 0; i < count; i++)
    for (int r = 0; r < CONTACT_ROWS; r++) {
      force[r] += column[i][r] * least[i];
      moved[r] += column[i][r] * (least[i] - x[i]);
    }
  for (int r = 0; r < CONTACT_ROWS; r++)
    after[r] = rate_after(of, right, force, r);
  for (int i = 0; i < count && imposed; i++)
    imposed[row[i]] = independent[i];
  for (int r = 0; r < CONTACT_ROWS && dependent; r++) {
    real size = fabs(right[r]);
    for (int j = 0; j < CONTACT_ROWS; j++)
      size += fabs(of->W[r * CONTACT_ROWS + j] * force[j]);
    if (fabs(rate_after(of, still, moved, r)) > CONTACT_ROUNDING * size)
      return 0;
    for (int i = 0; i < count; i++)
      if (row[i] == r && fabs(after[r]) > CONTACT_ROUNDING * size)
        return 0;
  }
  return 1;
}

/* Present modes, with the directions of slips at a state, in space of (ahead.w) w + start. */
static void modes_at(const contact_terms *of, const real *modes, contact_mode *mode)
{
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const real *const w = of->rate + CONTACTS[k].tangential, *const start = modes + CONTACTS[k].direction + 1;
    mode[k] = mode_of(modes, k);
    if (CONTACTS[k].slips < 2 || start[-1] == 0.0 || mode[k].held)
      continue;
    const real along = start[2] * w[0] + start[3] * w[1], x[2] = {along * w[0] + start[0], along * w[1] + start[1]};
    for (int i = 0; i < 2 && length_of(x, 2) > 0.0; i++)
      mode[k].direction[i] = x[i] / length_of(x, 2);
  }
}

/* Forces of the rows in the modes among parameters, 0 if they are not defined. */
static int forces_at(real t, const real *q, const real *p, const real *parameters, contact_mode *mode, real *force,
    real *workspace)
{
  contact_terms of;
  real modes[EVENT_MODES], after[CONTACT_ROWS];
  const int status = rows_at(t, q, p, parameters, &of, workspace);
  for (int k = 0; k < EVENT_MODES; k++)
    modes[k] = parameters[MODE_PLACE[k]];
  modes_at(&of, modes, mode);
  if (status != OK || !solve_contacts(&of, mode, of.second, force, after, NULL))
    memset(force, 0, BYTES(CONTACT_ROWS));
  return status;
}

int NAME(contact_forces)(real t, const real *q, const real *p, const real *parameters, real *force, real *workspace)
{
  contact_mode mode[EVENT_CONTACTS];
  return forces_at(t, q, p, parameters, mode, force, workspace);
}

/* Multipliers and parameters for the functions of transitions: of dependent contacts the multipliers of least norm, and
 * the masks of all that are closed or stick. */
static int distribute(real t, const real *q, const real *p, const real *parameters, real *multipliers, real *shown,
    real *workspace)
{
  contact_mode mode[EVENT_CONTACTS];
  int any = 0, status;
  memcpy(shown, parameters, BYTES(PARAMETERS));
  for (int k = 0; k < EVENT_CONTACTS; k++)
    any |= parameters[MODE_PLACE[CONTACTS[k].held]] > CONTACT_HELD;
  status = any ? forces_at(t, q, p, parameters, mode, multipliers, workspace) : OK;
  for (int k = 0; k < EVENT_CONTACTS && any; k++) {
    const contact_places *at = CONTACTS + k;
    if (at->closed >= 0)
      shown[MODE_PLACE[at->closed]] = mode[k].closed;
    for (int i = 0; i < at->slips; i++)
      shown[MODE_PLACE[at->sticks + i]] = mode[k].sticks >> i & 1;
    shown[MODE_PLACE[at->held]] = shown[MODE_PLACE[at->held]] != 0.0;
  }
  return status;
}

/* Modes among which those of contacts are chosen, and their conditions on the rates right + W f of the rows: second
 * rates for forces, rates for impulses. is_free: open by its gap; rests: its slip is 0; begins: 1 or -1 if it slips
 * after it stuck; limit: 1 if static friction is its limit. */
typedef struct {
  const contact_terms *of;
  const real *right;
  real scale; /* of the rates */
  int is_strict; /* slips that begin have a rate */
  int is_relaxed; /* contacts at their limit do not stick */
  int is_free[EVENT_CONTACTS], rests[EVENT_CONTACTS], begins[EVENT_CONTACTS], limit[EVENT_CONTACTS];
  contact_mode role[EVENT_CONTACTS]; /* whether it may be closed, and its friction any (sticks) or in its direction */
} contact_problem;

/* Sets the modes of a contact that its gap and its slip at a state allow. */
static void allow_modes(contact_problem *in, int k, const contact_change *now)
{
  const contact_terms *const of = in->of;
  const contact_places *at = CONTACTS + k;
  const real *const w = of->rate + at->tangential, speed = at->slips > 0 ? of->speed[at->tangential] : 0.0;
  in->is_free[k] = of->absent[k] || now->leaves[k] ||
      (at->normal >= 0 && !now->touches[k] &&
          (of->value[at->normal] > CONTACT_ROUNDING * of->size[at->normal] ||
              of->rate[at->normal] > CONTACT_ROUNDING * of->speed[at->normal]));
  in->role[k] = in->is_free[k] ? CONTACT_IS_OPEN : CONTACT_SLIPS[1];
  if (in->is_free[k] || at->slips == 0)
    return;
  in->begins[k] = now->begins[k];
  in->rests[k] = !now->begins[k] && (now->rests[k] || length_of(w, at->slips) <= CONTACT_ROUNDING * speed);
  in->limit[k] = in->rests[k] || in->begins[k];
  if (in->limit[k])
    in->role[k] = CONTACT_STICKS;
  for (int i = 0; i < at->slips && !in->limit[k]; i++)
    in->role[k].direction[i] = w[i] / length_of(w, at->slips);
}

/* Whether modes satisfy the conditions; their forces, and the rates with them. */
static int is_consistent(const contact_problem *in, const contact_mode *mode, real *force, real *after)
{
  const contact_terms *const of = in->of;
  real small = CONTACT_ROUNDING * in->scale;
  if (!solve_contacts(of, mode, in->right, force, after, NULL))
    return 0;
  for (int r = 0; r < CONTACT_ROWS; r++)
    small = fmax(small, CONTACT_ROUNDING * fmax(fabs(in->right[r]), fabs(after[r])));
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const int normal = CONTACTS[k].normal, slip = CONTACTS[k].tangential, slips = CONTACTS[k].slips;
    real begin = 0.0, moves = 0.0, aside;
    if (in->is_free[k])
      continue;
    if (normal >= 0 && mode[k].closed && !(force[normal] * of->W[normal * (CONTACT_ROWS + 1)] > small))
      return 0;
    if (normal >= 0 && !mode[k].closed && after[normal] < -small)
      return 0;
    if (!mode[k].closed || slips == 0 || !(in->rests[k] || in->begins[k]))
      continue;
    for (int i = 0; i < slips; i++) {
      begin += mode[k].direction[i] * after[slip + i];
      moves = fmax(moves, fabs(after[slip + i]));
    }
    aside = slips == 2 ? mode[k].direction[0] * after[slip + 1] - mode[k].direction[1] * after[slip] : 0.0;
    if ((mode[k].sticks || mode[k].held) && /* the friction of one that is held is at most at its limit */
        (length_of(force + slip, slips) - friction_limit(of, k, in->limit[k], force)) *
                of->W[slip * (CONTACT_ROWS + 1)] >
            (in->is_relaxed && mode[k].sticks ? -small : small))
      return 0;
    if (mode[k].held ? moves > small
                     : !mode[k].sticks &&
                (!(begin > (in->is_strict && !in->begins[k] ? small : -small)) ||
                    fabs(aside) > fmax(small, CONTACT_ASIDE * begin)))
      return 0;
  }
  return 1;
}

/* Number of independent rows that a mode imposes. */
static int rank_of(const contact_problem *in, const contact_mode *mode)
{
  real force[CONTACT_ROWS], after[CONTACT_ROWS];
  int imposed[CONTACT_ROWS] = {0}, rank = 0;
  solve_contacts(in->of, mode, in->right, force, after, imposed);
  for (int r = 0; r < CONTACT_ROWS; r++)
    rank += imposed[r];
  return rank;
}

/* Marks the contacts whose rows the imposed ones determine; returns whether one of them is closed. */
static int hold_contacts(const contact_problem *in, contact_mode *mode)
{
  const int rank = rank_of(in, mode);
  int any = 0;
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const contact_mode now = mode[k];
    const int slips = CONTACTS[k].slips > 0 && !now.sticks && (in->rests[k] || in->begins[k]);
    mode[k].held = 0;
    if (now.closed ? !slips : in->is_free[k])
      continue;
    mode[k] = now.closed ? CONTACT_STICKS : CONTACT_SLIPS[1];
    const int held = rank_of(in, mode) == rank;
    mode[k] = now;
    mode[k].held = held;
    any |= held && now.closed;
  }
  return any;
}

/* Forces by projection onto the friction cones, contact by contact (M. Jean, Comput. Methods Appl. Mech. Eng. 177,
 * 1999), from those given; role: whether a contact is closed, and its friction any (sticks) or in its direction.
 * Compliance distributes friction in proportion to its limits. */
static void relax(const contact_problem *in, real compliance, int sweeps, real *force)
{
  const contact_terms *const of = in->of;
  const contact_mode *const role = in->role;
  real strongest = 0.0;
  for (; sweeps > 0; sweeps--)
    for (int k = 0; k < EVENT_CONTACTS; k++) {
      const int normal = CONTACTS[k].normal, slip = CONTACTS[k].tangential, slips = CONTACTS[k].slips;
      real diagonal = normal < 0 ? 0.0 : of->W[normal * (CONTACT_ROWS + 1)], oblique = diagonal, trace = 0.0;
      real bound, size, friction[2] = {0.0, 0.0};
      for (int i = 0; i < slips; i++) {
        trace += of->W[(slip + i) * (CONTACT_ROWS + 1)];
        if (normal >= 0 && !role[k].sticks)
          oblique -= of->coefficient[3 * k] * role[k].direction[i] * of->W[normal * CONTACT_ROWS + slip + i];
      }
      if (normal >= 0)
        force[normal] -= rate_after(of, in->right, force, normal) / (oblique > 0.0 ? oblique : diagonal);
      if (normal >= 0 && !(role[k].closed && force[normal] > 0.0))
        force[normal] = 0.0;
      bound = role[k].closed ? friction_limit(of, k, in->limit[k], force) : 0.0;
      strongest = fmax(strongest, bound);
      const real kept = 1.0 - fmin(compliance * strongest, bound) / fmax(bound, DBL_MIN);
      for (int i = 0; i < slips; i++)
        friction[i] = role[k].sticks
            ? kept * force[slip + i] - rate_after(of, in->right, force, slip + i) / trace
            : -bound * role[k].direction[i];
      size = length_of(friction, slips);
      for (int i = 0; i < slips; i++)
        force[slip + i] = friction[i] * (role[k].sticks && size > bound ? bound / size : 1.0);
    }
}

/* Modes of forces in the friction cones; those below their limits stick. Where others determine a slip its friction is
 * kept relative to the normal force. Returns whether a limit changed, that of a slip that begins. */
static int modes_of_forces(contact_problem *in, int trial, const real *force, contact_mode *mode)
{
  const contact_terms *const of = in->of;
  const contact_mode *const role = in->role;
  real small = in->scale;
  int changed = 0;
  for (int r = 0; r < CONTACT_ROWS; r++)
    small = fmax(small, fabs(in->right[r]));
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const int normal = CONTACTS[k].normal;
    const real tau = length_of(force + CONTACTS[k].tangential, CONTACTS[k].slips);
    mode[k] = role[k];
    if (normal >= 0 && force[normal] * of->W[normal * (CONTACT_ROWS + 1)] <= CONTACT_ROUNDING * small)
      mode[k] = CONTACT_IS_OPEN;
    if ((trial == 0 && in->begins[k]) ||
        (mode[k].sticks && tau >= (1.0 - CONTACT_ROUNDING) * friction_limit(of, k, in->limit[k], force)))
      mode[k].sticks = 0;
  }
  hold_contacts(in, mode);
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const int slip = CONTACTS[k].tangential;
    const int slips = mode[k].closed && !mode[k].sticks && role[k].sticks ? CONTACTS[k].slips : 0;
    const real length = length_of(force + slip, slips), limit = friction_limit(of, k, 0, force);
    for (int i = 0; i < slips && length > 0.0 && limit > 0.0; i++)
      mode[k].direction[i] = -force[slip + i] / length * (mode[k].held ? length / limit : 1.0);
    if (slips > 0 && !mode[k].held && in->limit[k]) {
      in->limit[k] = 0;
      changed |= of->coefficient[3 * k] != of->coefficient[3 * k + 1];
    }
  }
  return changed;
}

/* Finds consistent modes: all contacts that meet closed, all slips at rest sticking; else by relaxation of the forces,
 * from the present ones, then from 0, with friction in proportion to its limits. If slips without a rate are all that
 * is consistent, these begin. Returns 0 if none is found. */
static int relax_modes(contact_problem *in, real *force, contact_mode *best)
{
  real exact[CONTACT_ROWS], after[CONTACT_ROWS];
  contact_mode mode[EVENT_CONTACTS];
  int limit[EVENT_CONTACTS], found = 0, begins = 0;
  memcpy(best, in->role, sizeof mode);
  for (int k = 0; k < EVENT_CONTACTS; k++)
    begins |= in->begins[k];
  if (!begins && !hold_contacts(in, best) && is_consistent(in, best, exact, after))
    return 1;
  in->is_relaxed = 1;
  memcpy(limit, in->limit, sizeof limit);
  for (int trial = 0; trial < CONTACT_TRIALS; trial++) {
    const int sweeps = CONTACT_SWEEPS << trial;
    memcpy(in->limit, limit, sizeof limit);
    if (trial > 0)
      relax(in, CONTACT_COMPLIANCE, sweeps, force);
    for (int changes = 0, changed = 1; changed && changes <= EVENT_CONTACTS; changes++) {
      relax(in, 0.0, sweeps, force);
      changed = modes_of_forces(in, trial, force, mode);
    }
    for (in->is_strict = 1; in->is_strict >= found; in->is_strict--)
      if (is_consistent(in, mode, exact, after)) {
        memcpy(best, mode, sizeof mode);
        found = 1;
        if (in->is_strict)
          return 1;
      }
    if (trial == 0)
      memset(force, 0, BYTES(CONTACT_ROWS));
  }
  return found;
}

/* Notes why no motion is possible; contact k, or all. */
static int refuse(const event_step *step, int reason, int k, real value)
{
  step->watch->refusal = reason;
  step->watch->refused = k + 1;
  step->watch->behind = value;
  return NOT_CONVERGED;
}

/* The first contact of Painleve's paradox, G M^-1 (G - mu d T)^T <= 0 of a slip, at rest in any direction; -1: none. */
static int painleve(const contact_problem *in, int at_rest, real *entry)
{
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const int normal = CONTACTS[k].normal, slips = CONTACTS[k].slips;
    const real *const W = in->of->W + normal * CONTACT_ROWS, *const coupling = W + CONTACTS[k].tangential;
    real along = in->limit[k] && at_rest ? length_of(coupling, slips) : 0.0;
    if (normal < 0 || slips == 0 || in->is_free[k])
      continue;
    for (int j = 0; j < slips; j++)
      along += in->role[k].direction[j] * coupling[j];
    *entry = W[normal] - in->of->coefficient[3 * k] * along;
    if (*entry <= 0.0)
      return k;
  }
  return -1;
}

/* Whether friction is negative, less static than sliding at rest, or a restitution is not in [0, 1]. */
static int is_impossible(const contact_terms *of, int k)
{
  const real mu = of->coefficient[3 * k], held = of->coefficient[3 * k + 1], e = of->coefficient[3 * k + 2];
  const int slip = CONTACTS[k].tangential;
  const int rests = slip >= 0 && length_of(of->rate + slip, CONTACTS[k].slips) <= CONTACT_ROUNDING * of->speed[slip];
  return !(mu >= 0.0 && held >= 0.0 && e >= 0.0 && e <= 1.0) || (rests && held < (1.0 - CONTACT_ROUNDING) * mu);
}

/* Sets the consistent modes at a state that stick most, of redundant contacts those near given forces. */
static int choose_modes(const event_step *step, const contact_terms *of, const contact_change *now, real *force)
{
  contact_problem in = {.of = of, .right = of->second, .is_strict = 1};
  contact_mode best[EVENT_CONTACTS];
  real second[CONTACT_ROWS], entry = 0.0;
  int imposed[CONTACT_ROWS] = {0};
  for (int k = 0; k < EVENT_CONTACTS; k++)
    allow_modes(&in, k, now);
  if (!relax_modes(&in, force, best)) {
    const int paradox = painleve(&in, 1, &entry);
    return refuse(step, CONTACT_WITHOUT_MODE, paradox, paradox < 0 ? 0.0 : entry);
  }
  step->watch->ambiguous |= painleve(&in, 0, &entry) >= 0;
  solve_contacts(of, best, of->second, force, second, imposed);
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const int normal = CONTACTS[k].normal, slip = CONTACTS[k].tangential;
    const int is_slow = CONTACTS[k].slips > 0 && (in.rests[k] || in.begins[k]);
    real speed = slip < 0 ? 0.0 : of->speed[slip]; /* and that by forces that cancel */
    int sticks = 0;
    for (int i = 0; i < CONTACTS[k].slips && best[k].sticks; i++)
      sticks |= imposed[slip + i] << i;
    if (best[k].closed && normal >= 0 && !imposed[normal])
      best[k].held |= CONTACT_LOADED;
    if (best[k].sticks && sticks != (1 << CONTACTS[k].slips) - 1)
      best[k].held |= CONTACT_STUCK;
    best[k].sticks = sticks;
    for (int j = 0; j < CONTACT_ROWS && slip >= 0; j++)
      speed += fabs(of->W[slip * CONTACT_ROWS + j] * force[j] * step->whole);
    put_mode(CONTACTS + k, best[k], is_slow || slip < 0 ? AT_REST : of->rate + slip, speed, step->watch->mode);
    if (is_slow) {
      step->watch->fastest[k] = fmax(step->watch->fastest[k], speed);
      step->watch->began[k] = step->watch->time;
      step->watch->whole[k] = fabs(step->whole);
    }
  }
  put_modes(step->watch->mode, step->own);
  return OK;
}

/* Impulses of a contact that approaches with the given rates, and of those that are closed, in consistent modes; 0 if
 * there are none. */
static int impulses_of(const contact_terms *of, int contact, const int *closed, real restitution, const real *rate,
    real *impulse)
{
  contact_problem in = {.of = of};
  contact_mode mode[EVENT_CONTACTS];
  real right[CONTACT_ROWS], after[CONTACT_ROWS];
  memcpy(right, rate, sizeof right);
  right[CONTACTS[contact].normal] *= 1.0 + restitution;
  in.right = right;
  for (int r = 0; r < CONTACT_ROWS; r++)
    in.scale = fmax(in.scale, of->speed[r]);
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    in.is_free[k] = CONTACTS[k].normal < 0 || !(k == contact || closed[k]);
    in.rests[k] = !in.is_free[k] && CONTACTS[k].slips > 0;
    in.role[k] = in.is_free[k] ? CONTACT_IS_OPEN : in.rests[k] ? CONTACT_STICKS
                                                               : CONTACT_SLIPS[1];
  }
  memset(impulse, 0, BYTES(CONTACT_ROWS));
  return relax_modes(&in, impulse, mode) && is_consistent(&in, mode, impulse, after);
}

/* Adds to the impulses of a compression those of a restitution, with e times its normal impulse in the friction cone
 * (C. Glocker & F. Pfeiffer, Nonlinear Dyn. 7, 1995): as those of a contact that approaches with a rate, which follows
 * by secants. */
static int restitute(const contact_terms *of, int contact, const int *closed, const real *rate, real *impulse)
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
    exists = impulses_of(of, contact, closed, 0.0, after, added);
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

/* Impulses of the rows of contacts that approach, one after another, until none does, by a law of restitution, in the
 * friction cone. Closed contacts take part with e = 0. */
static int find_impulses(const event_step *step, const contact_terms *of, const int *approaches, const int *closed,
    int law, real *total)
{
  memset(total, 0, BYTES(CONTACT_ROWS));
  for (int round = 0; round < CONTACT_IMPACTS * EVENT_CONTACTS; round++) {
    real rate[CONTACT_ROWS], impulse[CONTACT_ROWS];
    int meets = -1;
    for (int r = 0; r < CONTACT_ROWS; r++)
      rate[r] = rate_after(of, of->rate, total, r);
    for (int k = EVENT_CONTACTS - 1; k >= 0; k--)
      if (approaches[k] && rate[CONTACTS[k].normal] < -CONTACT_ROUNDING * of->speed[CONTACTS[k].normal])
        meets = k;
    if (meets < 0)
      return OK;
    if (!impulses_of(of, meets, closed, law == CONTACT_NEWTON ? of->coefficient[3 * meets + 2] : 0.0, rate, impulse) ||
        (law == CONTACT_POISSON && !restitute(of, meets, closed, rate, impulse)))
      return refuse(step, CONTACT_WITHOUT_IMPULSE, meets, 0.0);
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

/* Whether the height w^2 / (2 g'') of a rebound is of the size of rounding, or of the residual of the located zero; of
 * a gap that moves, of that of the search, which sees no rounding of time. */
static int is_low(const event_step *step, const contact_terms *before, const contact_terms *of, int k)
{
  const int row = CONTACTS[k].normal;
  real lowest = CONTACT_LOWEST * of->rounding[row] + CONTACT_RESIDUALS * fabs(before->value[row]);
  for (int i = 0; i < TRANSITIONS && of->drift[row] > CONTACT_ROUNDING * of->speed[row]; i++)
    if (TRANSITION[i][0] == k && TRANSITION[i][1] == CONTACT_CLOSES)
      lowest += 4.0 * step->watch->history[EVENT_FIRST[FIRST_TRANSITION + i]].slack;
  return of->rate[row] * of->rate[row] <= -2.0 * of->second[row] * lowest;
}

/* Impulses of all contacts that meet at a state, by the first law that creates no kinetic energy, and which contacts
 * touch and rest afterwards. */
static int collide(const event_step *step, event_sample *at, contact_terms *of, const int *closed, contact_change *now)
{
  const contact_terms before = *of;
  real impulse[CONTACT_ROWS];
  int approaches[EVENT_CONTACTS], law = CONTACT_NEWTON, status;
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const int normal = CONTACTS[k].normal;
    approaches[k] = normal >= 0 && !of->absent[k] && !now->leaves[k] &&
        (now->closes[k] || (!closed[k] && fabs(of->value[normal]) <= CONTACT_ROUNDING * of->size[normal]));
  }
  status = find_impulses(step, of, approaches, closed, law, impulse);
  while (status == OK ? law < CONTACT_PLASTIC && gain_of(of, impulse) > CONTACT_GAIN : law == CONTACT_POISSON) {
    step->watch->refusal = 0;
    status = find_impulses(step, of, approaches, closed, ++law, impulse);
  }
  step->watch->law = law > step->watch->law ? law : step->watch->law;
  for (int r = 0; status == OK && r < CONTACT_ROWS; r++)
    for (int i = 0; i < M; i++)
      at->p[i] += of->G[r * M + i] * impulse[r];
  if (status == OK)
    status = terms_at(step, at, of);
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
    if (approaches[k] && (step->watch->accumulates[k] || is_low(step, &before, of, k)))
      now->touches[k] = 1;
    step->watch->accumulates[k] = 0;
  }
  return status;
}

/* Whether a slip that vanishes along its former direction stops: in space it may pass near 0. */
static int stops_at(const event_step *step, const contact_terms *of, int k)
{
  const real speed = fmax(step->watch->fastest[k], of->speed[CONTACTS[k].tangential]);
  return CONTACTS[k].slips == 1 || length_of(of->rate + CONTACTS[k].tangential, 2) <= CONTACT_SLOW * speed;
}

/* Impacts and new modes at a state, which is projected onto their constraints. */
static int change_modes(const event_step *step, event_sample *at, contact_change *now)
{
  contact_terms of;
  contact_mode present[EVENT_CONTACTS];
  real force[CONTACT_ROWS];
  int closed[EVENT_CONTACTS], approach = 0, status = terms_at(step, at, &of);
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const contact_mode mode = mode_of(step->watch->mode, k);
    closed[k] = CONTACTS[k].normal >= 0 && mode.closed && !now->leaves[k];
    now->touches[k] |= closed[k];
    now->rests[k] = mode.sticks || (mode.closed && mode.held) || (now->stops[k] && stops_at(step, &of, k));
    now->rests[k] &= !now->begins[k];
    approach |= now->closes[k] && !now->leaves[k] && of.rate[CONTACTS[k].normal] < 0.0;
  }
  if (status == OK)
    forces_at(at->t, at->q, at->p, step->own, present, force, step->workspace);
  if (status == OK && approach)
    status = collide(step, at, &of, closed, now);
  if (status == OK)
    status = choose_modes(step, &of, now, force);
  return status == OK ? satisfy_constraints(step, at->t, at->q, at->p, 1) : status;
}

/* Whether a condition of a contact has failed now: its gap may vanish again where that is 0 within rounding. */
static int has_just_left(const event_step *step, int k)
{
  const event_watch *watch = step->watch;
  int left = 0;
  for (int i = 0; i < TRANSITIONS; i++) {
    const NAME(event_history) *const history = watch->history + EVENT_FIRST[FIRST_TRANSITION + i];
    left |= TRANSITION[i][0] == k && TRANSITION[i][1] == CONTACT_LEAVES && history->hits > 0 &&
        fabs(watch->time - history->last) <= EVENT_TIE * fabs(step->whole);
  }
  return left;
}

/* Modes after the transitions among the crossings from `first` on, which have one state. */
static int change_contacts(const event_step *step, long long first, event_sample *at)
{
  contact_change now;
  int changed = 0;
  memset(&now, 0, sizeof now);
  for (long long i = first; i < *step->filled; i++)
    if (is_transition(step->found[i].function)) {
      const int *const transition = TRANSITION[step->found[i].function - FIRST_TRANSITION];
      const int k = transition[0];
      now.closes[k] |= transition[1] == CONTACT_CLOSES;
      now.leaves[k] |= transition[1] == CONTACT_LEAVES || (transition[1] == CONTACT_CLOSES && has_just_left(step, k));
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
  int status;
  memset(&now, 0, sizeof now);
  for (int k = 0; k < EVENT_CONTACTS; k++)
    put_mode(CONTACTS + k, CONTACT_IS_OPEN, AT_REST, 0.0, step->watch->mode);
  put_modes(step->watch->mode, step->own);
  status = terms_at(step, at, &of);
  for (int k = 0; status == OK && k < EVENT_CONTACTS; k++) {
    const int row = CONTACTS[k].normal;
    if (row >= 0 && !of.absent[k] && of.value[row] < -CONTACT_PENETRATION * of.size[row])
      status = refuse(step, CONTACT_PENETRATES, k, of.value[row]);
    if (status == OK && is_impossible(&of, k))
      status = refuse(step, CONTACT_IMPOSSIBLE, k, of.coefficient[3 * k]);
    now.closes[k] = row >= 0 && !of.absent[k] && fabs(of.value[row]) <= CONTACT_ROUNDING * of.size[row];
  }
  if (status == OK)
    status = change_modes(step, at, &now);
  return status;
}

/* Whether the function of a transition is not negative after a step without it; gaps of limited contacts may be. */
static int is_kept(int transition)
{
  const int kind = TRANSITION[transition][1];
  return kind == CONTACT_LEAVES || (kind == CONTACT_CLOSES && !IS_CONDITIONAL[FIRST_TRANSITION + transition]);
}

/* Fails if a gap is negative at the end of a step in which no transition was found. */
static int check_gaps(const event_step *step, const event_sample *right)
{
  contact_terms of;
  real value[EVENTS];
  int doubtful = 0, status = evaluate_functions(step, right, value);
  for (int i = 0; i < TRANSITIONS; i++)
    doubtful |= is_kept(i) && value[EVENT_FIRST[FIRST_TRANSITION + i]] < 0.0;
  if (status != OK || !doubtful)
    return status;
  memcpy(values_at(step, 0), value, BYTES(EVENTS));
  status = rounding_of(step, right);
  if (status == OK)
    status = terms_at(step, right, &of);
  for (int i = 0; status == OK && i < TRANSITIONS; i++) {
    const int e = EVENT_FIRST[FIRST_TRANSITION + i];
    const real rounding = CONTACT_MISSED * values_at(step, EVENT_DEGREE + 2)[e] + step->watch->history[e].slack +
        CONTACT_ROUNDING * of.size[CONTACTS[TRANSITION[i][0]].normal];
    if (is_kept(i) && value[e] < -rounding) {
      step->watch->through = FIRST_TRANSITION + i + 1;
      return NOT_CONVERGED;
    }
  }
  return status;
}

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

/* Present modes, the forces and second rates in them; returns 0 without slips in space, or without forces. */
static int slips_at(const event_step *step, const event_sample *at, contact_terms *of, contact_mode *mode, real *force,
    real *second, int *status)
{
  const real *const modes = step->watch->mode;
  int slips = 0;
  for (int k = 0; k < EVENT_CONTACTS; k++)
    slips |= CONTACTS[k].slips == 2 && modes[CONTACTS[k].direction] != 0.0 && !mode_of(modes, k).held;
  *status = slips ? terms_at(step, at, of) : OK;
  if (!slips || *status != OK)
    return 0;
  modes_at(of, modes, mode);
  return solve_contacts(of, mode, of->second, force, second, NULL);
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
  int status = NAME(step)(at->t, 0.5 * part, at->q, at->p, step->own, step->options, middle.q, middle.p, &own,
      step->workspace);
  if (status == OK)
    status = terms_at(step, &middle, &there);
  if (status != OK)
    return status;
  memcpy(right, there.second, sizeof right);
  in.right = right;
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const int slip = CONTACTS[k].tangential;
    in.limit[k] = mode[k].sticks;
    if (!begins[k])
      continue;
    mode[k] = CONTACT_STICKS;
    for (int i = 0; i < 2; i++)
      right[slip + i] += 2.0 / part * of->rate[slip + i];
  }
  memcpy(in.role, mode, sizeof in.role);
  relax(&in, 0.0, CONTACT_SWEEPS, force);
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const real *const tau = force + CONTACTS[k].tangential;
    for (int i = 0; begins[k] && i < 2; i++)
      mode[k].direction[i] = -tau[i] / length_of(tau, 2);
  }
  return status;
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
  int keeps[EVENT_CONTACTS], begins[EVENT_CONTACTS], changes = 0, turns = 0, status;
  *longest = INFINITY;
  if (!slips_at(step, at, &of, mode, force, second, &status))
    return status;
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const int slip = CONTACTS[k].tangential;
    const real *const start = step->watch->mode + CONTACTS[k].direction + 1, *const ahead = start + 2;
    const real *const w = of.rate + slip, size = length_of(w, 2), *const d = mode[k].direction;
    keeps[k] = begins[k] = -1;
    if (CONTACTS[k].slips < 2 || start[-1] == 0.0 || mode[k].held)
      continue;
    const real rate = d[0] * second[slip] + d[1] * second[slip + 1], by_friction = length_of(force + slip, 2) * of.W[slip * (CONTACT_ROWS + 1)];
    const real part = CONTACT_PART * size / fabs(rate), relaxes = CONTACT_RELAXES * size / by_friction;
    const real age = fabs(step->watch->time - step->watch->began[k]);
    const int kept = keeps_direction(start, w), stops = rate < -CONTACT_ROUNDING * by_friction;
    const int stiff = CONTACT_PART * by_friction > CONTACT_RELAXES * rate && relaxes < CONTACT_SHORT * step->watch->whole[k];
    step->watch->fastest[k] = fmax(step->watch->fastest[k], fmax(size, of.speed[slip]));
    keeps[k] = stops ? size <= CONTACT_SLOW * step->watch->fastest[k] : kept && (age == 0.0 || stiff);
    begins[k] = keeps[k] && !stops && age > 0.0;
    if (!stops)
      *longest = fmin(*longest, keeps[k] ? fmax(CONTACT_BEGIN * step->watch->whole[k], CONTACT_PART * age) : fmin(part, relaxes));
    else if (!keeps[k])
      *longest = fmin(*longest, part);
    turns |= begins[k];
    changes |= begins[k] || keeps[k] != kept || (!kept && ahead[0] * w[0] + ahead[1] * w[1] < CONTACT_TURN * size);
    for (int i = 0; i < 2; i++)
      direction[k][i] = size > 0.0 && !(keeps[k] && kept) ? w[i] / size : ahead[i];
  }
  if (turns)
    status = turn_slips(step, at, &of, begins, mode, force, fmin(*longest, most));
  if (status == OK && changes)
    status = add_change(step, FIRST_TRANSITION, at);
  for (int k = 0; status == OK && changes && k < EVENT_CONTACTS; k++) {
    real *const start = step->watch->mode + CONTACTS[k].direction + 1;
    for (int i = 0; keeps[k] >= 0 && i < 2; i++) {
      start[2 + i] = begins[k] ? mode[k].direction[i] : direction[k][i];
      start[i] = keeps[k] ? pow(CONTACT_FAST * step->watch->fastest[k], 2.0) * start[2 + i] : 0.0;
    }
  }
  put_modes(step->watch->mode, step->own);
  return status;
}
#endif
