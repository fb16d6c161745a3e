#include "contact_places.h"
#include "impacts.h"

/* Rows of contacts, gaps and slips, at a state, and the modes of their parameters (contacts.h). */
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
