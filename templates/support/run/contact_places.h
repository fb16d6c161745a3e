#include "cone.h"
#include "events.h"

/* Parameters of the modes of contacts, and sizes of their rows. Requires: parts/contacts.c.jinja. */
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
  CONTACT_CREATES_ENERGY, /* in steps of all sizes */
  CONTACT_CROWDS /* more rows are near in a step than a problem has */
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
    if (CONTACT_VECTOR[k] == 1) {
      sum += fabs(G[i] * q[i]);
      i++;
      continue;
    }
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
