#include "contact_forces.h"

/* Choice of modes: forces in the friction cones, by projection, propose them; the conditions of contacts.h decide. */
enum {
  CONTACT_MODES = 4096, /* that are tried where a relaxation finds none */
  CONTACT_OTHERS = 256, /* that are compared with the one that was found */
  CONTACT_TRIALS = 2, /* of a relaxation */
  CONTACT_SWEEPS = 50 /* over the forces of contacts */
};

#define CONTACT_BEGIN 1e-4 /* first part of a slip in space, relative to a step: longer than that of rounding */
#define CONTACT_REGULAR 1e-9 /* part of the diagonal of their equations, dimensionless, that is added to it */
#define CONTACT_APART 1e-5 /* part of their size by which the rates of two motions differ */
#define CONTACT_ASIDE 1e-9 /* largest angle between friction and slip in space */

/* Modes among which those of contacts are chosen, and their conditions on the rates right + W f of the rows: second
 * rates for forces, rates for impulses. is_free: open by its gap; rests: its slip is 0; begins: 1 or -1 if it slips
 * after it stuck; limit: 1 if static friction is its limit. */
typedef struct {
  const contact_terms *of;
  const real *right;
  const real *scale; /* of the rates of impulses, which may vanish at closed contacts; NULL: of forces */
  int is_strict; /* slips that begin have a rate */
  int lifts; /* contacts without force are open, else closed */
  int is_relaxed; /* contacts at their limit do not stick */
  int is_free[EVENT_CONTACTS], rests[EVENT_CONTACTS], begins[EVENT_CONTACTS], limit[EVENT_CONTACTS];
  contact_mode role[EVENT_CONTACTS]; /* whether it may be closed, and its friction any (sticks) or in its direction */
  real directed[EVENT_CONTACTS]; /* part of the friction limit of one that sticks that is in its direction */
  real weight, near[CONTACT_ROWS]; /* of the distance from forces nearby in the equations of forces (solve_cones) */
} contact_problem;

/* Sets the modes of a contact that its gap and its slip at a state allow; fastest: its slip so far. */
static void allow_modes(contact_problem *in, int k, const contact_change *now, real fastest)
{
  const contact_terms *const of = in->of;
  const contact_places *at = CONTACTS + k;
  const real *const w = of->rate + at->tangential;
  in->is_free[k] = of->absent[k] || now->leaves[k] ||
      (at->normal >= 0 && !now->touches[k] &&
          (of->value[at->normal] > CONTACT_ROUNDING * of->size[at->normal] ||
              of->rate[at->normal] > CONTACT_ROUNDING * of->speed[at->normal]));
  in->role[k] = in->is_free[k] ? CONTACT_IS_OPEN : CONTACT_SLIPS;
  if (in->is_free[k] || at->slips == 0)
    return;
  in->begins[k] = now->begins[k];
  in->rests[k] = !now->begins[k] && (now->rests[k] || length_of(w, at->slips) <= CONTACT_ROUNDING * fastest);
  in->limit[k] = in->rests[k] || in->begins[k];
  if (in->limit[k])
    in->role[k] = CONTACT_STICKS;
  for (int i = 0; i < at->slips && !in->limit[k]; i++)
    in->role[k].direction[i] = w[i] / length_of(w, at->slips);
}

/* Effect of rounding on the rates of a row, by their sizes in all rows on whose forces it depends, and by the terms of
 * a second rate: in free fall those of joints cancel. */
static real rounding_at_row(const contact_problem *in, const real *after, int row)
{
  real size = in->scale ? 0.0 : in->of->second_terms[row];
  for (int r = 0; r < CONTACT_ROWS; r++)
    if (in->of->W[row * CONTACT_ROWS + r] != 0.0)
      size = fmax(size, fmax(in->scale ? in->scale[r] : 0.0, fmax(fabs(in->right[r]), fabs(after[r]))));
  return CONTACT_ROUNDING * size;
}

/* Whether modes satisfy the conditions; their forces, and the rates with them: of impulses, which only act at once, any
 * in the friction cones. */
static int is_consistent(const contact_problem *in, const contact_mode *mode, real *force, real *after)
{
  const contact_terms *const of = in->of;
  const real *const sizes = in->scale ? of->speed : of->second_terms;
  if (solve_rows(of, mode, in->right, sizes, force, after, NULL) > CONTACT_OUTSIDE)
    return 0;
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const int normal = CONTACTS[k].normal, slip = CONTACTS[k].tangential, slips = CONTACTS[k].slips;
    const real small = rounding_at_row(in, after, normal < 0 ? slip : normal);
    real begin = 0.0, moves = 0.0, aside;
    if (in->is_free[k])
      continue;
    if (normal >= 0 && mode[k].closed &&
        !(force[normal] * of->W[normal * (CONTACT_ROWS + 1)] > (in->lifts ? small : -small)))
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
    mode[k] = now.closed ? CONTACT_STICKS : CONTACT_SLIPS;
    const int held = rank_of(in, mode) == rank;
    mode[k] = now;
    mode[k].held = held;
    any |= held && now.closed;
  }
  return any;
}

/* Subtracts a part of the derivatives of an unprojected force. */
static void subtract_derivative(const contact_problem *in, int row, real diagonal, real part, real *line)
{
  part /= 1.0 + in->weight;
  line[row] -= part;
  for (int j = 0; j < CONTACT_ROWS; j++)
    line[j] += part / diagonal * in->of->W[row * CONTACT_ROWS + j];
}

/* Lists the rows of a contact and returns their number. */
static int rows_of(int k, int *row)
{
  const contact_places *const at = CONTACTS + k;
  int count = 0;
  if (at->normal >= 0)
    row[count++] = at->normal;
  for (int i = 0; i < at->slips; i++)
    row[count++] = at->tangential + i;
  return count;
}

/* Part of the friction of a contact that is given, in the direction of its role. */
static real given_part(const contact_problem *in, int k)
{
  return in->role[k].sticks ? in->directed[k] : 1.0;
}

/* Force of a row by its rate, f - rate / diagonal, and by the forces nearby, before a projection. */
static real unprojected(const contact_problem *in, const real *force, int row, real diagonal)
{
  const real free = force[row] - rate_after(in->of, in->right, force, row) / diagonal;
  return (free + in->weight * in->near[row]) / (1.0 + in->weight);
}

/* Free part z = f - rate / trace, of friction without the given one, before the projection onto its part of the cone;
 * returns the factor by which that shortens it. */
static real free_friction(const contact_problem *in, int k, const real *force, real bound, real trace, real *z)
{
  const int slip = CONTACTS[k].tangential, slips = CONTACTS[k].slips;
  const real given = given_part(in, k);
  for (int i = 0; i < slips; i++)
    z[i] = given == 1.0 ? 0.0
                        : unprojected(in, force, slip + i, trace) + bound * given * in->role[k].direction[i];
  return fmin(1.0, (1.0 - given) * bound / fmax(length_of(z, slips), DBL_MIN));
}

static real trace_of(const contact_terms *of, int k)
{
  real trace = 0.0;
  for (int i = 0; i < CONTACTS[k].slips; i++)
    trace += of->W[(CONTACTS[k].tangential + i) * (CONTACT_ROWS + 1)];
  return trace;
}

/* Equations of forces in the friction cones, force = projection of force - rate / diagonal, and their derivatives, by
 * rows of closed contacts (P. Alart & A. Curnier, Comput. Methods Appl. Mech. Eng. 92, 1991). Returns the sum of
 * squares. */
static real state_projections(const contact_problem *in, const real *force, real (*line)[CONTACT_ROWS + 1])
{
  const contact_terms *const of = in->of;
  real sum = 0.0;
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const int normal = CONTACTS[k].normal, slip = CONTACTS[k].tangential, slips = CONTACTS[k].slips;
    const real bound = fmax(friction_limit(of, k, in->limit[k], force), 0.0), trace = trace_of(of, k);
    const real given = given_part(in, k);
    const real *const d = in->role[k].direction;
    real z[2] = {0.0}, n[2] = {0.0};
    int row[3], count = in->role[k].closed ? rows_of(k, row) : 0;
    for (int i = 0; i < count; i++) {
      memset(line[row[i]], 0, sizeof *line);
      line[row[i]][row[i]] = 1.0;
      line[row[i]][CONTACT_ROWS] = -force[row[i]];
    }
    if (normal >= 0 && count > 0) {
      const real diagonal = of->W[normal * (CONTACT_ROWS + 1)];
      const real push = unprojected(in, force, normal, diagonal);
      if (push > 0.0)
        subtract_derivative(in, normal, diagonal, 1.0, line[normal]);
      line[normal][CONTACT_ROWS] += fmax(push, 0.0);
    }
    const real across = count > 0 ? free_friction(in, k, force, bound, trace, z) : 0.0;
    for (int i = 0; i < slips && across < 1.0; i++)
      n[i] = z[i] / fmax(length_of(z, slips), DBL_MIN);
    for (int i = 0; i < slips && count > 0; i++) {
      real by_bound = (1.0 - given) * n[i] - given * d[i];
      for (int l = 0; l < slips; l++) {
        const real part = across * ((i == l) - n[i] * n[l]);
        subtract_derivative(in, slip + l, trace, part, line[slip + i]);
        by_bound += part * given * d[l];
      }
      if (normal >= 0 && bound > 0.0)
        line[slip + i][normal] -= bound / force[normal] * by_bound;
      line[slip + i][CONTACT_ROWS] += across * z[i] - bound * given * d[i];
    }
    for (int i = 0; i < count; i++)
      sum += line[row[i]][CONTACT_ROWS] * line[row[i]][CONTACT_ROWS];
  }
  return sum;
}

/* Solves for forces in the friction cones by Newton's method from those given, as far as residuals decrease. Returns
 * whether these are 0 within rounding. */
static int refine(const contact_problem *in, real *force)
{
  const real *const sizes = in->scale ? in->scale : in->of->second_terms;
  real line[CONTACT_ROWS][CONTACT_ROWS + 1], step[CONTACT_ROWS], trial[CONTACT_ROWS], size = DBL_MIN, part = 1.0;
  real rounding = 0.0;
  int row[CONTACT_ROWS], independent[CONTACT_ROWS], count = 0;
  for (int k = 0; k < EVENT_CONTACTS; k++)
    count += in->role[k].closed ? rows_of(k, row + count) : 0;
  real sum = state_projections(in, force, line);
  memcpy(trial, force, sizeof trial);
  for (int iteration = 0; part > CONTACT_EXACT && iteration < CONTACT_SWEEPS; iteration++) {
    real matrix[CONTACT_ROWS][CONTACT_ROWS + 1], next = INFINITY;
    for (int i = 0; i < count; i++) {
      for (int j = 0; j < count; j++)
        matrix[i][j] = line[row[i]][row[j]];
      matrix[i][i] += CONTACT_REGULAR; /* for dependent rows */
      matrix[i][count] = line[row[i]][CONTACT_ROWS];
      size = fmax(size, fabs(force[row[i]]));
      rounding = fmax(rounding, CONTACT_ROUNDING * sizes[row[i]] / in->of->W[row[i] * (CONTACT_ROWS + 1)]);
    }
    if (sqrt(sum) <= CONTACT_EXACT * size)
      return 1;
    eliminate(matrix, count, independent);
    for (int i = 0; i < count; i++)
      step[i] = independent[i] ? matrix[i][count] / matrix[i][i] : 0.0;
    for (part = 2.0; part > CONTACT_EXACT && !(next < (1.0 - 1e-4 * part) * sum);) {
      part *= 0.5;
      for (int i = 0; i < count; i++)
        trial[row[i]] = force[row[i]] + part * step[i];
      next = state_projections(in, trial, line);
    }
    if (next < sum)
      memcpy(force, trial, sizeof trial);
    sum = next;
  }
  return sqrt(sum) <= rounding;
}

/* Solves for forces in the friction cones from those given: by Newton's method; where that ends, by proximal points
 * (R. T. Rockafellar, SIAM J. Control Optim. 14, 1976), whose equations are well conditioned: a weight attracts forces
 * to those before and decreases with each solution. */
static int solve_cones(contact_problem *in, real *force)
{
  real trial[CONTACT_ROWS];
  int solved;
  memcpy(trial, force, sizeof trial);
  solved = refine(in, trial);
  in->weight = 1.0;
  for (int pass = 0; pass < CONTACT_SWEEPS && !solved && in->weight > CONTACT_REGULAR; pass++) {
    memcpy(in->near, force, sizeof trial);
    memcpy(trial, force, sizeof trial);
    const int is_near = refine(in, trial);
    if (is_near)
      memcpy(force, trial, sizeof trial);
    in->weight *= is_near ? 0.1 : 3.0;
  }
  in->weight = 0.0;
  if (solved)
    memcpy(force, trial, sizeof trial);
  return solved || refine(in, force);
}

/* Forces by projection onto the friction cones, contact by contact (M. Jean, Comput. Methods Appl. Mech. Eng. 177,
 * 1999), from those given, which keeps equal directions of friction, then by Newton's method; role: whether a contact
 * is closed, and its friction any (sticks) or in its direction. */
static void relax(contact_problem *in, real *force)
{
  const contact_terms *const of = in->of;
  const contact_mode *const role = in->role;
  for (int moves = 1, sweeps = 0; moves && sweeps < CONTACT_SWEEPS; sweeps++) {
    real before[CONTACT_ROWS];
    memcpy(before, force, sizeof before);
    moves = 0;
    for (int k = 0; k < EVENT_CONTACTS; k++) {
      const int normal = CONTACTS[k].normal, slip = CONTACTS[k].tangential, slips = CONTACTS[k].slips;
      real diagonal = normal < 0 ? 0.0 : of->W[normal * (CONTACT_ROWS + 1)], oblique = diagonal, z[2];
      int row[3];
      for (int i = rows_of(k, row) - 1; i >= 0 && !role[k].closed; i--)
        force[row[i]] = 0.0;
      if (!role[k].closed)
        continue;
      for (int i = 0; i < slips && normal >= 0 && !role[k].sticks; i++)
        oblique -= of->coefficient[3 * k] * role[k].direction[i] * of->W[normal * CONTACT_ROWS + slip + i];
      if (normal >= 0)
        force[normal] -= rate_after(of, in->right, force, normal) / (oblique > 0.0 ? oblique : diagonal);
      if (normal >= 0)
        force[normal] = fmax(force[normal], 0.0);
      const real bound = friction_limit(of, k, in->limit[k], force);
      const real across = free_friction(in, k, force, bound, trace_of(of, k), z);
      for (int i = 0; i < slips; i++)
        force[slip + i] = across * z[i] - bound * given_part(in, k) * role[k].direction[i];
    }
    for (int r = 0; r < CONTACT_ROWS; r++)
      moves |= fabs(force[r] - before[r]) > DBL_EPSILON * fabs(force[r]);
  }
  solve_cones(in, force);
}

/* Opens a contact, if other forces give the same rates of the imposed rows but not of all: the first of those that
 * carry no load along such forces. Returns whether there is one. */
static int unload(contact_problem *in, const contact_mode *mode, const real *force)
{
  const contact_terms *const of = in->of;
  contact_unknowns unknown;
  const real still[CONTACT_ROWS] = {0.0};
  real line[CONTACT_ROWS][CONTACT_ROWS + 1], none[CONTACT_ROWS], least = INFINITY;
  int independent[CONTACT_ROWS], first = -1;
  find_unknowns(of, mode, &unknown, none);
  if (!reduce_equations(of, &unknown, in->right, none, line, independent))
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

/* Modes of forces in the friction cones; those below their limits stick. Where others determine a slip its friction is
 * kept relative to the normal force. Returns whether a limit changed, that of a slip that begins. */
static int modes_of_forces(contact_problem *in, int trial, const real *force, contact_mode *mode)
{
  const contact_terms *const of = in->of;
  const contact_mode *const role = in->role;
  int changed = 0;
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const int normal = CONTACTS[k].normal;
    const real tau = length_of(force + CONTACTS[k].tangential, CONTACTS[k].slips);
    real least = in->scale || normal < 0 ? 0.0 : rounding_at_row(in, in->right, normal);
    for (int r = 0; in->scale && normal >= 0 && r < CONTACT_ROWS; r++) /* residuals of impulses, which others take */
      least = fmax(least, CONTACT_EXACT * fabs(of->W[normal * CONTACT_ROWS + r] * force[r]));
    mode[k] = role[k];
    if (normal >= 0 && force[normal] * of->W[normal * (CONTACT_ROWS + 1)] <= least)
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
    real after[2] = {0.0};
    for (int i = 0; i < slips && length > 0.0 && limit > 0.0; i++)
      mode[k].direction[i] = -force[slip + i] / length * (mode[k].held ? length / limit : 1.0);
    for (int i = 0; i < slips; i++)
      after[i] = rate_after(of, in->right, force, slip + i);
    for (int i = 0; i < slips && !(length > 0.0 && limit > 0.0) && length_of(after, slips) > 0.0; i++)
      mode[k].direction[i] = after[i] / length_of(after, slips); /* friction may grow from 0 */
    if (slips > 0 && !mode[k].held && in->limit[k]) {
      in->limit[k] = 0;
      changed |= of->coefficient[3 * k] != of->coefficient[3 * k + 1];
    }
  }
  return changed;
}

/* Modes that a contact may have, of which the first ones stick; beside the best one only those that static friction
 * does not distinguish from it. Slips in space at rest have no other direction. Returns their number. */
static int list_modes(const contact_problem *in, int k, const contact_mode *best, contact_mode *mode)
{
  const real *const friction = in->of->coefficient + 3 * k;
  const int line = CONTACTS[k].slips == 1 && in->role[k].sticks && !(best && friction[0] != friction[1]);
  int count = 0;
  if (!line || !in->begins[k])
    mode[count++] = line || !best || !best[k].closed ? in->role[k] : best[k];
  for (int way = 1; line && way >= -1; way -= 2) {
    mode[count] = CONTACT_SLIPS;
    mode[count++].direction[0] = way;
  }
  if (!in->is_free[k] && CONTACTS[k].normal >= 0)
    mode[count++] = CONTACT_IS_OPEN;
  return count;
}

/* First consistent modes among all, beside the best ones of which rates differ from theirs; 0 if there are none, or too
 * many to try. */
static int enumerate_modes(contact_problem *in, const contact_mode *best, const real *rates, int most,
    contact_mode *mode)
{
  real force[CONTACT_ROWS], after[CONTACT_ROWS], size = 0.0;
  contact_mode list[EVENT_CONTACTS][4];
  int count[EVENT_CONTACTS], total = 1;
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    count[k] = list_modes(in, k, best, list[k]);
    total *= total <= most ? count[k] : 1;
  }
  for (int r = 0; r < CONTACT_ROWS; r++)
    size = fmax(size, fabs(in->right[r]));
  in->is_strict = in->is_relaxed = 0;
  for (int number = 0; total <= most && number < total; number++) {
    int differs = !best;
    for (int k = 0, rest = number; k < EVENT_CONTACTS; rest /= count[k++])
      mode[k] = list[k][rest % count[k]];
    if (!is_consistent(in, mode, force, after))
      continue;
    for (int r = 0; r < CONTACT_ROWS && best; r++)
      differs |= fabs(after[r] - rates[r]) > CONTACT_APART * fmax(size, fabs(after[r])) + rounding_at_row(in, after, r);
    if (differs)
      return 1;
  }
  return 0;
}

/* Finds consistent modes: all contacts that meet closed, all slips at rest sticking; else by relaxation of the forces,
 * from the present ones, then from 0, with friction in proportion to its limits. If slips without a rate are all that
 * is consistent, these begin; else by trial of all. Returns 0 if none is found. */
static int relax_modes(contact_problem *in, real *force, contact_mode *best)
{
  real exact[CONTACT_ROWS], after[CONTACT_ROWS];
  contact_mode mode[EVENT_CONTACTS];
  contact_mode role[EVENT_CONTACTS];
  int limit[EVENT_CONTACTS], found = 0, begins = 0;
  memcpy(role, in->role, sizeof role);
  memcpy(best, in->role, sizeof mode);
  for (int k = 0; k < EVENT_CONTACTS; k++)
    begins |= in->begins[k];
  if (!begins && !hold_contacts(in, best) && is_consistent(in, best, exact, after))
    return 1;
  in->is_relaxed = 1;
  memcpy(limit, in->limit, sizeof limit);
  for (int trial = 0; trial < CONTACT_TRIALS; trial++) {
    memcpy(in->limit, limit, sizeof limit);
    memcpy(in->role, role, sizeof role);
    do { /* all contacts carry loads, else some do not */
      for (int changes = 0, changed = 1; changed && changes <= EVENT_CONTACTS; changes++) {
        relax(in, force);
        changed = modes_of_forces(in, trial, force, mode);
      }
      for (in->is_strict = 1; in->is_strict >= found; in->is_strict--)
        if (is_consistent(in, mode, exact, after)) {
          memcpy(best, mode, sizeof mode);
          found = 1;
          if (in->is_strict) {
            memcpy(in->role, role, sizeof role);
            return 1;
          }
        }
    } while (!found && unload(in, mode, force));
    memset(force, 0, BYTES(CONTACT_ROWS));
  }
  memcpy(in->limit, limit, sizeof limit);
  memcpy(in->role, role, sizeof role);
  in->is_strict = 0;
  return found || enumerate_modes(in, NULL, NULL, CONTACT_MODES, best);
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

/* Sets the consistent modes at a state that stick most, of redundant contacts those near given forces. */
static int choose_modes(const event_step *step, const contact_terms *of, const contact_change *now, real *force)
{
  contact_problem in = {.of = of, .right = of->second, .is_strict = 1, .lifts = now->lifts};
  contact_mode best[EVENT_CONTACTS], other[EVENT_CONTACTS];
  real second[CONTACT_ROWS], impossible = 0.0;
  int imposed[CONTACT_ROWS] = {0}, directed[EVENT_CONTACTS] = {0};
  contact_mode present[EVENT_CONTACTS];
  modes_at(of, step->watch->mode, present);
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    allow_modes(&in, k, now, step->watch->fastest[k]);
    const real *const start = step->watch->mode + CONTACTS[k].direction + 1, *const d = present[k].direction;
    const int slip = CONTACTS[k].tangential, slips = CONTACTS[k].slips;
    const int is_still = in.limit[k] && length_of(of->rate + slip, slips) <= CONTACT_ROUNDING * of->speed[slip];
    const int reason = in.is_free[k] ? 0 : impossible_reason(of, k, is_still, 0, &impossible);
    if (reason)
      return refuse(step, reason, k, impossible);
    directed[k] = slips == 2 && in.role[k].closed && !in.limit[k] && start[-1] != 0.0 && !present[k].held &&
        keeps_direction(start, of->rate + slip);
    for (int i = 0; directed[k] && i < 2; i++)
      in.role[k].direction[i] = d[i] / length_of(d, 2); /* friction would jump to that of the rate */
  }
  int found = relax_modes(&in, force, best);
  for (int k = 0; k < EVENT_CONTACTS && !found; k++) { /* where another slip unloads the one at its limit, that stays */
    in.rests[k] |= in.begins[k] != 0;
    in.begins[k] = 0;
  }
  if (!found && !relax_modes(&in, force, best))
    return refuse(step, CONTACT_WITHOUT_MODE, -1, 0.0);
  solve_contacts(of, best, of->second, force, second, imposed);
  step->watch->ambiguous |= enumerate_modes(&in, best, second, CONTACT_OTHERS, other);
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const int normal = CONTACTS[k].normal, slip = CONTACTS[k].tangential;
    const int is_slow = CONTACTS[k].slips > 0 && (in.rests[k] || in.begins[k]);
    real speed = slip < 0 ? 0.0 : of->speed[slip]; /* and that by forces that cancel */
    int sticks = 0;
    for (int i = 0; i < CONTACTS[k].slips && best[k].sticks; i++)
      sticks |= imposed[slip + i] << i;
    if (!best[k].closed && second[normal] > rounding_at_row(&in, second, normal)) /* leaves, as straight legs bend */
      best[k].held = 0;
    if (best[k].closed && normal >= 0 && !imposed[normal])
      best[k].held |= CONTACT_LOADED;
    if (best[k].sticks && sticks != (1 << CONTACTS[k].slips) - 1)
      best[k].held |= CONTACT_STUCK;
    best[k].sticks = sticks;
    for (int j = 0; j < CONTACT_ROWS && slip >= 0; j++)
      speed += fabs(of->W[slip * CONTACT_ROWS + j] * force[j] * step->whole);
    const real *const w = is_slow || directed[k] || slip < 0 ? AT_REST : of->rate + slip;
    put_mode(CONTACTS + k, best[k], w, speed, step->watch->mode);
    if (is_slow)
      step->watch->fastest[k] = fmax(step->watch->fastest[k], speed);
    step->watch->keeps[k] = 0;
    step->watch->part[k] = (is_slow ? CONTACT_BEGIN : 1.0) * fabs(step->whole);
  }
  put_modes(step->watch->mode, step->own);
  return OK;
}
