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
  CONTACTS_AT_ONCE = 6, /* largest number of contacts whose modes are enumerated */
  CONTACT_OPTIONS = 5, /* open, stick, slip in either direction, held by others */
  CONTACT_DIRECTIONS = 32, /* of a slip in space, between which one is enclosed */
  CONTACT_SWEEPS = 50, /* over several slips that begin */
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
#define CONTACT_BRAKES 0.25 /* longest part of a step relative to the time to a stop of a slip in space .. */
#define CONTACT_GROWS 0.3 /* .. and relative to that since its beginning */
#define CONTACT_PENETRATION 1e-9 /* part of its size by which a gap may be negative at a start */
#define CONTACT_MISSED 128.0 /* effects of rounding beyond which a negative gap shows a missed transition */
#define CONTACT_LOWEST 16.0 /* roundings of a gap below which a rebound ends */
#define CONTACT_RESIDUALS 16.0 /* residuals of its located zero below which a rebound ends */
#define CONTACT_TURN 0.866 /* cosine of an angle after which a direction is renewed */
#define CONTACT_DEPENDENT 1e-12 /* part of a column below which a pivot counts as 0 */
#define CONTACT_GAIN 1e-9 /* part of the work of an impact by which energy may grow */

/* What the modes of contacts do not allow, in watch->refusal. */
enum {
  CONTACT_PENETRATES = 1,
  CONTACT_WITHOUT_MODE, /* Painleve's paradox, or redundant contacts */
  CONTACTS_UNDECIDED, /* too many */
  CONTACT_WITHOUT_IMPULSE,
  CONTACT_IN_CORNER,
  CONTACT_IMPOSSIBLE /* coefficients */
};

/* A contact without gap is always closed; one without friction does not stick, and has direction 0. Slip in space that
 * begins has a direction to be found, 0 until then. */
typedef struct {
  int closed, sticks;
  real direction[2];
} contact_mode;

static const real AT_REST[2] = {0.0, 0.0};
static const contact_mode CONTACT_IS_OPEN = {0, 0, {0.0, 0.0}};
static const contact_mode CONTACT_STICKS = {1, 1, {0.0, 0.0}};
static const contact_mode CONTACT_SLIPS[3] = {{1, 0, {-1.0, 0.0}}, {1, 0, {0.0, 0.0}}, {1, 0, {1.0, 0.0}}};

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
  real toward[EVENT_CONTACTS][2]; /* of slips that begin in space, against the friction while it stuck */
  int touches[EVENT_CONTACTS], rests[EVENT_CONTACTS];
} contact_change;

static real length_of(const real *x, int count)
{
  return count < 2 ? fabs(x[0]) : hypot(x[0], x[1]);
}

/* Present mode of a contact; without the direction of a slip in space, which is that of its velocity. */
static contact_mode mode_of(const event_step *step, int k)
{
  const contact_places *at = CONTACTS + k;
  const real *mode = step->watch->mode;
  const contact_mode now = {
      at->closed < 0 || mode[at->closed] != 0.0,
      at->sticks >= 0 && mode[at->sticks] != 0.0,
      {at->slips == 1 ? mode[at->direction] : 0.0, 0.0},
  };
  return now;
}

/* Sets the parameters of a mode. In the plane the direction of slip is one, d. In space it is that of (ahead.w) w +
 * start: smooth where w vanishes and slip stops, beyond which ahead.w < 0, with the direction `ahead` at an earlier
 * step; the second term keeps the direction of slow slips. */
static void put_mode(const contact_places *at, contact_mode mode, const real *w, real speed, real *modes)
{
  real *const slides = modes + at->direction;
  if (at->closed >= 0)
    modes[at->closed] = mode.closed;
  if (at->slips > 0)
    modes[at->sticks] = mode.sticks;
  if (at->slips == 1)
    slides[0] = mode.direction[0];
  for (int i = 0; at->slips == 2 && i < 2; i++) {
    slides[0] = mode.closed && !mode.sticks;
    slides[1 + i] = length_of(w, 2) > CONTACT_SLOW * speed ? 0.0 : speed * speed * mode.direction[i];
    slides[3 + i] = mode.direction[i];
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

static int terms_at(const event_step *step, const event_sample *at, contact_terms *of)
{
  real idle[PARAMETERS], imposed[PARAMETERS], mode[EVENT_MODES], *const v = step->memory + 3 * M, power = 0.0;
  const real duration = fabs(step->whole);
  real *const numbers = of->numbers;
  int status;
  memcpy(idle, step->own, BYTES(PARAMETERS));
  memcpy(imposed, step->own, BYTES(PARAMETERS));
  memcpy(mode, step->watch->mode, sizeof mode);
  for (int k = 0; k < EVENT_CONTACTS; k++)
    put_mode(CONTACTS + k, CONTACT_IS_OPEN, AT_REST, 0.0, mode);
  put_modes(mode, idle);
  for (int k = 0; k < EVENT_CONTACTS; k++)
    put_mode(CONTACTS + k, CONTACT_STICKS, AT_REST, 0.0, mode);
  put_modes(mode, imposed);
  status = NAME(contact_terms)(at->t, at->q, at->p, idle, imposed, numbers, step->workspace);
  if (status == OK)
    status = NAME(velocity)(at->t, at->q, at->p, idle, v, step->workspace);
  of->value = numbers;
  of->rate = of->value + CONTACT_ROWS;
  of->second = of->rate + CONTACT_ROWS;
  of->W = of->second + CONTACT_ROWS;
  of->G = of->W + CONTACT_ROWS * CONTACT_ROWS;
  of->coefficient = of->G + CONTACT_ROWS * M;
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

/* Solves A x = b in place of the last column of the rows (A, b), by elimination with pivots; returns 0 if A is
 * singular but for rounding. */
static int eliminate(real (*line)[CONTACT_ROWS + 1], int count)
{
  for (int i = 0; i < count; i++) {
    int best = i;
    real size = 0.0;
    for (int r = i; r < count; r++)
      best = fabs(line[r][i]) > fabs(line[best][i]) ? r : best;
    for (int r = 0; r < count; r++)
      size = fmax(size, fabs(line[r][i]));
    if (!(fabs(line[best][i]) > CONTACT_DEPENDENT * size))
      return 0;
    for (int j = i; j <= count; j++) {
      const real swapped = line[i][j];
      line[i][j] = line[best][j];
      line[best][j] = swapped;
    }
    for (int r = 0; r < count; r++) {
      const real factor = line[r][i] / line[i][i];
      for (int j = i; r != i && j <= count; j++)
        line[r][j] -= factor * line[i][j];
    }
  }
  for (int i = 0; i < count; i++)
    line[i][count] /= line[i][i];
  return 1;
}

/* Solves for the forces of the rows in given modes with after = right + W f = 0 in imposed rows; returns 0 if these are
 * dependent. */
static int solve_contacts(const contact_terms *of, const contact_mode *mode, const real *right, real *force,
    real *after)
{
  real matrix[CONTACT_ROWS][CONTACT_ROWS + 1], column[CONTACT_ROWS][CONTACT_ROWS]; /* forces by unknowns */
  int row[CONTACT_ROWS], count = 0;
  memset(force, 0, BYTES(CONTACT_ROWS));
  memset(column, 0, sizeof column);
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const contact_places *at = CONTACTS + k;
    real *const sliding = at->normal < 0 ? force : column[count];
    for (int i = 0; i < at->slips; i++)
      sliding[at->tangential + i] = -of->coefficient[3 * k] * mode[k].direction[i];
    if (at->normal >= 0 && mode[k].closed) {
      row[count] = at->normal;
      column[count++][at->normal] = 1.0;
    }
    for (int i = 0; i < at->slips && mode[k].sticks; i++) {
      row[count] = at->tangential + i;
      column[count++][at->tangential + i] = 1.0;
    }
  }
  for (int i = 0; i < count; i++) {
    const real *W = of->W + row[i] * CONTACT_ROWS;
    for (int j = 0; j <= count; j++)
      matrix[i][j] = j < count ? 0.0 : -right[row[i]];
    for (int r = 0; r < CONTACT_ROWS; r++) {
      for (int j = 0; j < count; j++)
        matrix[i][j] += W[r] * column[j][r];
      matrix[i][count] -= W[r] * force[r];
    }
  }
  if (!eliminate(matrix, count))
    return 0;
  for (int i = 0; i < count; i++)
    for (int r = 0; r < CONTACT_ROWS; r++)
      force[r] += column[i][r] * matrix[i][count];
  for (int r = 0; r < CONTACT_ROWS; r++) {
    after[r] = right[r];
    for (int j = 0; j < CONTACT_ROWS; j++)
      after[r] += of->W[r * CONTACT_ROWS + j] * force[j];
  }
  return 1;
}

/* Largest friction force or impulse of a contact, by its coefficient of sliding (0) or sticking (1). */
static real friction_limit(const contact_terms *of, int k, int which, const real *force)
{
  return of->coefficient[3 * k + which] * (CONTACTS[k].normal < 0 ? 1.0 : force[CONTACTS[k].normal]);
}

/* Modes of a contact that its gap and its slip at a state allow; returns their number. */
static int options_of(const contact_terms *of, int k, contact_change *now, contact_mode *option)
{
  const contact_places *at = CONTACTS + k;
  const real *const w = of->rate + at->tangential, speed = at->slips > 0 ? of->speed[at->tangential] : 0.0;
  int count = 0;
  if (at->normal >= 0)
    option[count++] = CONTACT_IS_OPEN;
  if (of->absent[k] || now->leaves[k] ||
      (at->normal >= 0 && !now->touches[k] &&
          (of->value[at->normal] > CONTACT_ROUNDING * of->size[at->normal] ||
              of->rate[at->normal] > CONTACT_ROUNDING * of->speed[at->normal])))
    return count;
  if (at->slips == 0) {
    option[count++] = CONTACT_SLIPS[1];
  } else if (now->begins[k]) {
    option[count++] = CONTACT_SLIPS[at->slips == 2 ? 1 : 1 + now->begins[k]];
  } else if (now->rests[k] || length_of(w, at->slips) <= CONTACT_ROUNDING * speed) {
    now->rests[k] = 1;
    option[count++] = CONTACT_STICKS;
    option[count++] = CONTACT_SLIPS[at->slips == 2 ? 1 : 2];
    if (at->slips == 1) {
      option[count++] = CONTACT_SLIPS[0];
      option[count++] = CONTACT_SLIPS[1]; /* held by others, whose rows depend on its own */
    }
  } else {
    option[count] = CONTACT_SLIPS[1];
    for (int i = 0; i < at->slips; i++)
      option[count].direction[i] = w[i] / length_of(w, at->slips);
    count++;
  }
  return count;
}

/* Moment d x w' and component d.w' of the rates of a slip in the direction d = (cos angle, sin angle). */
static int turn_slip(const contact_terms *of, int k, real angle, const real *right, contact_mode *mode, real *moment,
    real *along)
{
  real force[CONTACT_ROWS], after[CONTACT_ROWS], *const d = mode[k].direction;
  const real *const w = after + CONTACTS[k].tangential;
  d[0] = cos(angle);
  d[1] = sin(angle);
  if (!solve_contacts(of, mode, right, force, after))
    return 0;
  *moment = d[0] * w[1] - d[1] * w[0];
  *along = d[0] * w[0] + d[1] * w[1];
  return 1;
}

/* Finds the direction of a slip that begins, that of its own rate: d x w' = 0, d.w' > 0; 0 if there is none. */
static int find_direction(const contact_terms *of, int k, const real *right, contact_mode *mode)
{
  const real turn = 6.283185307179586 / CONTACT_DIRECTIONS;
  real low, high, along;
  for (int i = 0; i < CONTACT_DIRECTIONS; i++) {
    real from = i * turn, to = from + turn;
    if (!turn_slip(of, k, from, right, mode, &low, &along) || !turn_slip(of, k, to, right, mode, &high, &along))
      return 0;
    if ((low > 0.0) == (high > 0.0))
      continue;
    for (int bisection = 0; bisection < DBL_MANT_DIG; bisection++) {
      const real middle = from + 0.5 * (to - from);
      real moment;
      if (!turn_slip(of, k, middle, right, mode, &moment, &along))
        return 0;
      if ((moment > 0.0) == (low > 0.0))
        from = middle;
      else
        to = middle;
    }
    if (along > 0.0)
      return 1;
  }
  return 0;
}

/* Finds the directions of slips in space that begin; returns 0 if one has none. */
static int find_directions(const contact_terms *of, const int *begins, const real *right, contact_mode *mode)
{
  int count = 0, exists = 1;
  for (int k = 0; k < EVENT_CONTACTS; k++)
    count += begins[k];
  for (int sweep = 0; exists && sweep < (count > 1 ? CONTACT_SWEEPS : count); sweep++)
    for (int k = 0; k < EVENT_CONTACTS; k++)
      exists &= !begins[k] || find_direction(of, k, right, mode);
  return exists;
}

/* Which contacts in space begin to slip in a mode. */
static void list_beginning(const contact_mode *mode, const int *rests, int *begins)
{
  for (int k = 0; k < EVENT_CONTACTS; k++)
    begins[k] = CONTACTS[k].slips == 2 && rests[k] && mode[k].closed && !mode[k].sticks;
}

/* Whether a contact in a plane rests without friction, since others hold it. */
static int is_held(const contact_mode *mode, int slips)
{
  return slips == 1 && mode->closed && !mode->sticks && mode->direction[0] == 0.0;
}

/* Whether modes, whose unknown directions are found, satisfy the conditions; is_free: contacts that are open by their
 * gap. */
static int is_consistent(const contact_terms *of, contact_mode *mode, const int *is_free, const contact_change *now)
{
  real force[CONTACT_ROWS], second[CONTACT_ROWS], small = 0.0;
  int begins[EVENT_CONTACTS];
  list_beginning(mode, now->rests, begins);
  if (!find_directions(of, begins, of->second, mode))
    return 0;
  for (int k = 0; k < EVENT_CONTACTS; k++)
    if (CONTACTS[k].slips == 2 && now->begins[k] && mode[k].closed && !find_direction(of, k, of->second, mode))
      memcpy(mode[k].direction, now->toward[k], sizeof now->toward[k]);
  if (!solve_contacts(of, mode, of->second, force, second))
    return 0;
  for (int r = 0; r < CONTACT_ROWS; r++)
    small = fmax(small, CONTACT_ROUNDING * fmax(fabs(of->second[r]), fabs(second[r])));
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const int normal = CONTACTS[k].normal, slip = CONTACTS[k].tangential, slips = CONTACTS[k].slips;
    real begin = 0.0;
    if (is_free[k])
      continue;
    if (normal >= 0 && mode[k].closed && !(force[normal] * of->W[normal * (CONTACT_ROWS + 1)] > small))
      return 0;
    if (normal >= 0 && !mode[k].closed && second[normal] < -small)
      return 0;
    if (!mode[k].closed || slips == 0)
      continue;
    if (mode[k].sticks &&
        (length_of(force + slip, slips) - friction_limit(of, k, 1, force)) * of->W[slip * (CONTACT_ROWS + 1)] > small)
      return 0;
    for (int i = 0; i < slips; i++)
      begin += mode[k].direction[i] * second[slip + i];
    if (!mode[k].sticks && now->begins[k] && begin < -small)
      return 0;
    if (is_held(mode + k, slips) ? fabs(second[slip]) > small
                                 : !mode[k].sticks && now->rests[k] && !now->begins[k] && !(begin > small))
      return 0;
  }
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

/* Names the contact of Painleve's paradox by its entry of G M^-1 (G - mu d T)^T <= 0, if there is one. */
static int refuse_modes(const event_step *step, const contact_terms *of, contact_mode (*option)[CONTACT_OPTIONS],
    const int *options)
{
  for (int k = 0; k < EVENT_CONTACTS; k++)
    for (int i = 0; i < options[k] && CONTACTS[k].normal >= 0; i++) {
      const real *W = of->W + CONTACTS[k].normal * CONTACT_ROWS;
      real entry = W[CONTACTS[k].normal];
      for (int j = 0; j < CONTACTS[k].slips; j++)
        entry -= of->coefficient[3 * k] * option[k][i].direction[j] * W[CONTACTS[k].tangential + j];
      if (entry <= 0.0)
        return refuse(step, CONTACT_WITHOUT_MODE, k, entry);
    }
  return refuse(step, CONTACT_WITHOUT_MODE, -1, 0.0);
}

/* Whether a mode sticks by static friction above that of sliding, so that slip would begin, too. */
static int needs_static_friction(const contact_terms *of, const contact_mode *mode)
{
  real force[CONTACT_ROWS], second[CONTACT_ROWS];
  int needs = 0;
  if (!solve_contacts(of, mode, of->second, force, second))
    return 0;
  for (int k = 0; k < EVENT_CONTACTS; k++)
    needs |= mode[k].sticks &&
        length_of(force + CONTACTS[k].tangential, CONTACTS[k].slips) > friction_limit(of, k, 0, force);
  return needs;
}

/* Whether friction is negative, less static than sliding at rest, or a restitution is not in [0, 1]. */
static int is_impossible(const contact_terms *of, int k)
{
  const real mu = of->coefficient[3 * k], held = of->coefficient[3 * k + 1], e = of->coefficient[3 * k + 2];
  const int slip = CONTACTS[k].tangential;
  const int rests = slip >= 0 && length_of(of->rate + slip, CONTACTS[k].slips) <= CONTACT_ROUNDING * of->speed[slip];
  return !(mu >= 0.0 && held >= 0.0 && e >= 0.0 && e <= 1.0) || (rests && held < (1.0 - CONTACT_ROUNDING) * mu);
}

/* Sets the consistent modes at a state that stick most: the first of those with the least sum of 2 for each contact
 * that does not stick, less 1 for each that is closed. */
static int choose_modes(const event_step *step, const contact_terms *of, contact_change *now)
{
  contact_mode option[EVENT_CONTACTS][CONTACT_OPTIONS], mode[EVENT_CONTACTS], best[EVENT_CONTACTS];
  int options[EVENT_CONTACTS], place[EVENT_CONTACTS] = {0}, is_free[EVENT_CONTACTS];
  int undecided = 0, consistent = 0, least = 1 << 30;
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    options[k] = options_of(of, k, now, option[k]);
    undecided += options[k] > 1;
    is_free[k] = options[k] == 1 && !option[k][0].closed;
  }
  if (undecided > CONTACTS_AT_ONCE)
    return refuse(step, CONTACTS_UNDECIDED, undecided - 1, 0.0);
  for (int with_held = 0; with_held < 2 && !consistent; with_held++) {
    for (int more = 1; more;) {
      int weight = 0, held = 0;
      for (int k = 0; k < EVENT_CONTACTS; k++) {
        mode[k] = option[k][place[k]];
        weight += 2 * !mode[k].sticks - mode[k].closed;
        held |= options[k] > 1 && is_held(mode + k, CONTACTS[k].slips);
      }
      if (held == with_held && is_consistent(of, mode, is_free, now)) {
        consistent++;
        if (weight < least)
          memcpy(best, mode, sizeof best);
        least = weight < least ? weight : least;
      }
      more = 0;
      for (int k = EVENT_CONTACTS - 1; k >= 0 && !more; k--) { /* the next of all combinations */
        place[k] = (place[k] + 1) % options[k];
        more = place[k] > 0;
      }
    }
  }
  if (!consistent)
    return refuse_modes(step, of, option, options);
  if (consistent > step->watch->ambiguous && !needs_static_friction(of, best))
    step->watch->ambiguous = consistent;
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const int slip = CONTACTS[k].tangential;
    const int is_slow = CONTACTS[k].slips > 0 && (now->rests[k] || now->begins[k]);
    put_mode(CONTACTS + k, best[k], is_slow || slip < 0 ? AT_REST : of->rate + slip, slip < 0 ? 0.0 : of->speed[slip],
        step->watch->mode);
  }
  put_modes(step->watch->mode, step->own);
  return OK;
}

/* Whether the impulses and the rates after an impact satisfy its conditions. */
static int obeys(const contact_terms *of, const contact_mode *mode, const int *takes_part, const real *impulse,
    const real *after, real small)
{
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const int normal = CONTACTS[k].normal, slip = CONTACTS[k].tangential;
    real along = 0.0;
    if (!takes_part[k])
      continue;
    if (!mode[k].closed && after[normal] < -small)
      return 0;
    if (mode[k].closed && impulse[normal] * of->W[normal * (CONTACT_ROWS + 1)] < -small)
      return 0;
    if (mode[k].sticks &&
        (length_of(impulse + slip, CONTACTS[k].slips) - friction_limit(of, k, 0, impulse)) *
                of->W[slip * (CONTACT_ROWS + 1)] >
            small)
      return 0;
    for (int i = 0; i < CONTACTS[k].slips; i++)
      along += mode[k].direction[i] * after[slip + i];
    if (mode[k].closed && !mode[k].sticks && along < -small)
      return 0;
  }
  return 1;
}

/* Impulses of a contact that approaches with the given rates, and of those that are closed, in the first consistent
 * modes; 0 if there are none. */
static int impulses_of(const contact_terms *of, int contact, const int *closed, real restitution, const real *rate,
    real *impulse)
{
  contact_mode option[EVENT_CONTACTS][CONTACT_OPTIONS], mode[EVENT_CONTACTS];
  int options[EVENT_CONTACTS], place[EVENT_CONTACTS] = {0}, takes_part[EVENT_CONTACTS], begins[EVENT_CONTACTS];
  int more = 1;
  real right[CONTACT_ROWS], after[CONTACT_ROWS], small = 0.0;
  memcpy(right, rate, sizeof right);
  right[CONTACTS[contact].normal] *= 1.0 + restitution;
  for (int r = 0; r < CONTACT_ROWS; r++)
    small = fmax(small, CONTACT_ROUNDING * of->speed[r]);
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    int count = 0;
    takes_part[k] = CONTACTS[k].normal >= 0 && (k == contact || closed[k]);
    if (k != contact)
      option[k][count++] = CONTACT_IS_OPEN;
    if (takes_part[k] && CONTACTS[k].slips > 0) {
      option[k][count++] = CONTACT_STICKS;
      option[k][count++] = CONTACT_SLIPS[CONTACTS[k].slips == 2 ? 1 : 2];
      if (CONTACTS[k].slips == 1)
        option[k][count++] = CONTACT_SLIPS[0];
    } else if (takes_part[k]) {
      option[k][count++] = CONTACT_SLIPS[1];
    }
    options[k] = count;
  }
  while (more) {
    for (int k = 0; k < EVENT_CONTACTS; k++)
      mode[k] = option[k][place[k]];
    list_beginning(mode, takes_part, begins);
    if (find_directions(of, begins, right, mode) && solve_contacts(of, mode, right, impulse, after) &&
        obeys(of, mode, takes_part, impulse, after, small))
      return 1;
    more = 0;
    for (int k = EVENT_CONTACTS - 1; k >= 0 && !more; k--) {
      place[k] = (place[k] + 1) % options[k];
      more = place[k] > 0;
    }
  }
  return 0;
}

/* Adds to the impulses of a compression those of a restitution, with e times its normal impulse in the friction cone
 * (C. Glocker & F. Pfeiffer, Nonlinear Dyn. 7, 1995): as those of a contact that approaches with a rate, which follows
 * by secants. */
static int restitute(const contact_terms *of, int contact, const int *closed, const real *rate, real *impulse)
{
  const int normal = CONTACTS[contact].normal;
  const real goal = of->coefficient[3 * contact + 2] * impulse[normal];
  real after[CONTACT_ROWS], added[CONTACT_ROWS], low = 0.0, of_low = 0.0;
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
    for (int r = 0; r < CONTACT_ROWS; r++) {
      rate[r] = of->rate[r];
      for (int j = 0; j < CONTACT_ROWS; j++)
        rate[r] += of->W[r * CONTACT_ROWS + j] * total[j];
    }
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
    real change = of->rate[r];
    for (int j = 0; j < CONTACT_ROWS; j++)
      change += 0.5 * of->W[r * CONTACT_ROWS + j] * impulse[j];
    gain += impulse[r] * change;
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

/* Directions of slips in space that begin, against the forces while they stuck. */
static void find_toward(const event_step *step, const contact_terms *of, contact_change *now)
{
  contact_mode mode[EVENT_CONTACTS];
  real force[CONTACT_ROWS], second[CONTACT_ROWS];
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    mode[k] = mode_of(step, k);
    for (int i = 0; i < 2 && CONTACTS[k].slips == 2 && mode[k].closed && !mode[k].sticks; i++)
      mode[k].direction[i] = of->rate[CONTACTS[k].tangential + i] / length_of(of->rate + CONTACTS[k].tangential, 2);
  }
  if (!solve_contacts(of, mode, of->second, force, second))
    return;
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const real *const tau = force + CONTACTS[k].tangential;
    for (int i = 0; i < CONTACTS[k].slips; i++)
      now->toward[k][i] = -tau[i] / length_of(tau, CONTACTS[k].slips);
  }
}

/* Impacts and new modes at a state, which is projected onto their constraints. */
static int change_modes(const event_step *step, event_sample *at, contact_change *now)
{
  contact_terms of;
  int closed[EVENT_CONTACTS], approach = 0, slips = 0, status = terms_at(step, at, &of);
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const contact_mode mode = mode_of(step, k);
    closed[k] = CONTACTS[k].normal >= 0 && mode.closed && !now->leaves[k];
    now->touches[k] |= closed[k];
    now->rests[k] = (mode.sticks || (now->stops[k] && stops_at(step, &of, k))) && !now->begins[k];
    slips |= now->begins[k] && CONTACTS[k].slips == 2;
    approach |= now->closes[k] && !now->leaves[k] && of.rate[CONTACTS[k].normal] < 0.0;
  }
  if (status == OK && slips)
    find_toward(step, &of, now);
  if (status == OK && approach)
    status = collide(step, at, &of, closed, now);
  if (status == OK)
    status = choose_modes(step, &of, now);
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

/* Slips in space at the beginning of a part of a step. Solutions are not smooth where they stop, and steps do not
 * resolve where they begin: the direction of slow ones is kept, and steps are in proportion to |w|/|w'|, at most
 * *longest. The direction `ahead` of others is renewed after a turn. */
static int follow_slips(const event_step *step, const event_sample *at, real *longest)
{
  contact_terms of;
  contact_mode mode[EVENT_CONTACTS];
  real force[CONTACT_ROWS], second[CONTACT_ROWS];
  int slips = 0, status;
  *longest = INFINITY;
  for (int k = 0; k < EVENT_CONTACTS; k++)
    slips |= CONTACTS[k].slips == 2 && step->watch->mode[CONTACTS[k].direction] != 0.0;
  status = slips ? terms_at(step, at, &of) : OK;
  if (!slips || status != OK)
    return status;
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const real *const w = of.rate + CONTACTS[k].tangential;
    const real *const start = step->watch->mode + CONTACTS[k].direction + 1;
    mode[k] = mode_of(step, k);
    for (int i = 0; i < 2 && CONTACTS[k].slips == 2 && mode[k].closed && !mode[k].sticks; i++)
      mode[k].direction[i] = keeps_direction(start, w) ? start[2 + i] : w[i] / length_of(w, 2);
  }
  if (!solve_contacts(&of, mode, of.second, force, second))
    return OK;
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const int slip = CONTACTS[k].tangential;
    real *const start = step->watch->mode + CONTACTS[k].direction + 1, *const ahead = start + 2;
    const real *const w = of.rate + slip, size = CONTACTS[k].slips == 2 ? length_of(w, 2) : 0.0;
    if (CONTACTS[k].slips < 2 || start[-1] == 0.0)
      continue;
    const real *const d = mode[k].direction, rate = d[0] * second[slip] + d[1] * second[slip + 1];
    const int keeps = keeps_direction(start, w);
    real *const fastest = step->watch->fastest + k;
    *fastest = fmax(*fastest, fmax(size, of.speed[slip]));
    const real slow = CONTACT_SLOW * *fastest;
    const int is_slow = rate < 0.0 && size <= slow, is_released = keeps && size > slow;
    if (keeps && !is_released)
      *longest = fmin(*longest, rate > 0.0 ? 2.0 * slow / rate : INFINITY);
    else if (!is_slow)
      *longest = fmin(*longest, (rate < 0.0 ? CONTACT_BRAKES : CONTACT_GROWS) * size / fabs(rate));
    const int turns = ahead[0] * w[0] + ahead[1] * w[1] < CONTACT_TURN * size;
    if (keeps ? !is_released : !(is_slow || turns))
      continue;
    status = add_change(step, FIRST_TRANSITION, at);
    if (status != OK)
      return status;
    for (int i = 0; i < 2; i++) {
      ahead[i] = w[i] / size;
      start[i] = is_slow ? *fastest * *fastest * ahead[i] : 0.0;
    }
  }
  put_modes(step->watch->mode, step->own);
  return status;
}
#endif
