#include "cone.h"
#include "events.h"
#include "impacts.h"

/* Rows of contacts, gaps and slips, at a state, and the parameters of their modes (contacts.h). Requires:
 * parts/contacts.c.jinja. */
#define CONTACT_SLOW 1e-6 /* part of its size below which the direction of a slip in space is kept */
#define CONTACT_PENETRATION 1e-9 /* part of its size by which a gap may be negative at a start */
#define CONTACT_LOWEST 16.0 /* roundings of a gap below which a rebound ends */
#define CONTACT_FAST 1e3 /* speed relative to that of a slip whose direction is kept */

/* What the modes of contacts do not allow, in watch->refusal. */
enum {
  CONTACT_PENETRATES = 1,
  CONTACT_WITHOUT_MODE, /* and without impact: redundant contacts */
  CONTACT_WITHOUT_IMPULSE,
  CONTACT_IMPOSSIBLE, /* friction, or a coefficient that is undefined */
  CONTACT_LEAVES_CONE,
  CONTACT_WEAKENS, /* static friction at rest, below that of sliding */
  CONTACT_REPELS, /* restitution */
  CONTACT_CREATES_ENERGY /* in steps of all sizes */
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

/* Second rate whose change of a slip in a step counts as 0, relative to the fastest so far, by CONTACT_ROUNDING. */
#define CONTACT_AT_REST (DBL_EPSILON / CONTACT_ROUNDING)

static const real AT_REST[2] = {0.0, 0.0};
static const contact_mode CONTACT_IS_OPEN = {0, 0, 0, {0.0, 0.0}};
static const contact_mode CONTACT_STICKS = {1, 3, 0, {0.0, 0.0}};
static const contact_mode CONTACT_SLIPS = {1, 0, 0, {0.0, 0.0}};

/* Rows at a state: values and rates, second rates b, the terms of values and of b by whose rounding these differ, W and
 * G by rows, coefficients (mu, mu_s, e; limits of friction without gap), their roundings, the sizes of values and
 * rates, the rounding of values, and rates at rest. */
typedef struct {
  real numbers[CONTACT_NUMBERS];
  const real *value, *rate, *second, *terms, *W, *G;
  real *second_terms, *coefficient, *noise;
  real size[CONTACT_ROWS], speed[CONTACT_ROWS], rounding[CONTACT_ROWS], drift[CONTACT_ROWS];
  int absent[EVENT_CONTACTS]; /* whether a condition of the contact fails, or the state is behind it */
} contact_terms;

/* Transitions that end a mode together, and their consequences: contacts that close, or whose conditions fail, slips
 * that stop, directions of slips that begin, whether contacts lift; contacts with g = g' = 0, and with w = 0. */
typedef struct {
  int closes[EVENT_CONTACTS], leaves[EVENT_CONTACTS], stops[EVENT_CONTACTS], begins[EVENT_CONTACTS];
  int lifts, touches[EVENT_CONTACTS], rests[EVENT_CONTACTS];
} contact_change;

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

#ifdef CONTACTS_IN_SPACE
/* The direction of slip in space is that of (ahead.w) w + start: smooth where w vanishes and slip stops, beyond which
 * ahead.w < 0, with the direction `ahead` at an earlier step; the second term keeps the direction of slow slips. */
static void put_ahead(contact_mode mode, const real *w, real speed, real *slides)
{
  const int held = mode.held & CONTACT_HELD, slips = mode.closed && !mode.sticks && !(mode.held & CONTACT_STUCK);
  const real size = length_of(mode.direction, 2), fast = pow(CONTACT_FAST * speed, 2.0);
  const real slow = length_of(w, 2) > CONTACT_SLOW * speed ? 0.0 : fast;
  slides[0] = held ? size : slips;
  for (int i = 0; i < 2; i++) {
    slides[1 + i] = (held && size > 0.0 ? fast / size : slow) * mode.direction[i];
    slides[3 + i] = held ? 0.0 : mode.direction[i];
  }
}
#else
#define put_ahead(mode, w, speed, slides) (void)(w), (void)(speed)
#endif

/* Sets the parameters of a mode with rates of slip w; in the plane the direction of slip is one, d. */
static void put_mode(const contact_places *at, contact_mode mode, const real *w, real speed, real *modes)
{
  real *const slides = modes + at->direction;
  if (at->closed >= 0)
    modes[at->closed] = mode.closed && !(mode.held & CONTACT_LOADED);
  modes[at->held] = mode.held;
  for (int i = 0; i < at->slips; i++)
    modes[at->sticks + i] = mode.sticks >> i & 1;
  if (at->slips == 1)
    slides[0] = mode.direction[0];
  else if (at->slips == 2)
    put_ahead(mode, w, speed, slides);
}

/* Size of the terms of a row by positions. Of a rotation or a direction, on whose length it does not depend, that is
 * |G| |q| instead of a sum by components: of a quaternion twice the derivative by an angle. */
static real size_by_position(const real *G, const real *q)
{
  real sum = 0.0;
  for (int k = 0, i = 0; k < CONTACT_VECTORS; k++) {
    real gradient = 0.0, position = 0.0;
    for (const int next = i + CONTACT_VECTOR[k]; i < next; i++) {
      gradient += G[i] * G[i];
      position += q[i] * q[i];
    }
    sum += sqrt(gradient * position);
  }
  return sum;
}

/* Sets the parameters of one mode of all contacts. */
static void put_in_all(contact_mode now, real *parameters)
{
  real mode[EVENT_MODES];
  for (int k = 0; k < EVENT_MODES; k++)
    mode[k] = parameters[MODE_PLACE[k]];
  for (int k = 0; k < EVENT_CONTACTS; k++)
    put_mode(CONTACTS + k, now, AT_REST, 0.0, mode);
  put_modes(mode, parameters);
}

/* Evaluates the numbers of the rows at a state; coefficients that are negative within rounding are 0. */
static int rows_at(real t, const real *q, const real *p, const real *parameters, contact_terms *of, real *workspace)
{
  real idle[PARAMETERS], imposed[PARAMETERS];
  memcpy(idle, parameters, BYTES(PARAMETERS));
  memcpy(imposed, parameters, BYTES(PARAMETERS));
  put_in_all(CONTACT_IS_OPEN, idle);
  put_in_all(CONTACT_STICKS, imposed);
  of->value = of->numbers;
  of->rate = of->value + CONTACT_ROWS;
  of->second = of->rate + CONTACT_ROWS;
  of->terms = of->second + CONTACT_ROWS;
  of->second_terms = of->numbers + 4 * CONTACT_ROWS;
  of->W = of->second_terms + CONTACT_ROWS;
  of->G = of->W + CONTACT_ROWS * CONTACT_ROWS;
  of->coefficient = of->numbers + CONTACT_ROWS * (5 + CONTACT_ROWS + M);
  of->noise = of->coefficient + 3 * EVENT_CONTACTS;
  TRY(NAME(contact_terms)(t, q, p, idle, imposed, of->numbers, workspace));
  for (int i = 0; i < 3 * EVENT_CONTACTS; i++) { /* differences of large terms vanish within rounding */
    of->noise[i] = is_finite(of->noise[i]) ? CONTACT_LOWEST * DBL_EPSILON * of->noise[i] : 0.0;
    if (of->coefficient[i] < 0.0 && of->coefficient[i] >= -of->noise[i])
      of->coefficient[i] = 0.0;
  }
  return OK;
}

static int terms_at(const event_step *step, const event_sample *at, contact_terms *of)
{
  real *const v = step->memory + 3 * M, power = 0.0;
  const real duration = fabs(step->whole);
  event_sample next = {.t = at->t + EVENT_SAME_TIME * fabs(at->t), .q = v + M};
  TRY(rows_at(at->t, at->q, at->p, step->own, of, step->workspace));
  TRY(NAME(velocity)(at->t, at->q, at->p, step->own, v, step->workspace));
  for (int i = 0; i < M; i++) {
    power += at->p[i] * v[i];
    next.q[i] = at->q[i] + EVENT_TIE * step->whole * v[i];
  }
  for (int r = 0; r < CONTACT_ROWS; r++) {
    const real by_position = size_by_position(of->G + r * M, at->q);
    real by_velocity = 0.0;
    for (int i = 0; i < M; i++)
      by_velocity += of->G[r * M + i] * v[i];
    /* |G v| <= sqrt(G M^-1 G^T) sqrt(v^T M v), and changes of the rate in a step, by forces that stop others, too */
    const real fast = sqrt(fabs(of->W[r * (CONTACT_ROWS + 1)] * power)) + fabs(of->rate[r] - by_velocity);
    of->speed[r] = fast + fabs(of->second[r]) * duration;
    for (int j = 0; j < CONTACT_ROWS; j++) { /* W_rj / W_jj: rate of r by a force that changes that of j by 1 */
      const real *const W = of->W + j * CONTACT_ROWS;
      of->speed[r] += j == r ? 0.0 : fabs(W[r] / fmax(W[j], DBL_MIN) * of->second[j]) * duration;
    }
    of->drift[r] = fabs(of->rate[r] - by_velocity);
    of->rounding[r] = DBL_EPSILON * (fmax(by_position, of->terms[r]) + fabs(at->t) * of->drift[r]);
    /* low rebounds in long steps are above rounding; forces, which those of contacts cancel at rest, have that of b */
    of->size[r] = fmax(by_position, of->terms[r]) + (fast + DBL_EPSILON * of->second_terms[r] * duration) * duration;
  }
  for (int k = 0; k < EVENT_CONTACTS && duration > 0.0; k++) /* rounding of bodies at rest without forces */
    for (int i = 0; i < CONTACTS[k].slips; i++)
      of->second_terms[CONTACTS[k].tangential + i] += CONTACT_AT_REST * step->watch->fastest[k] / duration;
  memset(of->absent, 0, sizeof of->absent);
  for (int i = 0; i < TRANSITIONS; i++) {
    const int event = FIRST_TRANSITION + i, k = TRANSITION[i][0], row = CONTACTS[k].normal;
    int exists;
    if (TRANSITION[i][1] != CONTACT_CLOSES || !IS_CONDITIONAL[event])
      continue;
    TRY(conditions(EVENT_FIRST[event], next.t, at->q, at->p, step->parameters, &exists, step->workspace));
    if (!exists) /* within rounding, as where one contact replaces another */
      TRY(conditions(EVENT_FIRST[event], next.t, next.q, at->p, step->parameters, &exists, step->workspace));
    of->absent[k] = !exists || of->value[row] < -CONTACT_PENETRATION * of->size[row];
  }
  return OK;
}
