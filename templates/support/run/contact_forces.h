#include "contact_rows.h"

/* Forces of contacts in their modes: W f = -b for the imposed rows of r'' = b + W f (contacts.h). */
enum {
  CONTACT_LEVELS = 3, /* of pivots, from 1 down to CONTACT_DEPENDENT */
  CONTACT_DESCENTS = 50 /* of the barrier of friction, for each of its extensions */
};

/* CONTACT_ROUNDING for modes that a run keeps, whose slips have turned since: directions of those as slow as
 * CONTACT_SLOW, from which on they are kept, have rounding errors of DBL_EPSILON / CONTACT_SLOW (measured: .6). */
#define CONTACT_OUTSIDE (4.0 * DBL_EPSILON / CONTACT_SLOW)
#define CONTACT_EXACT 0x1p-40 /* residual of refined forces in the friction cones, and least part of a descent */
#define CONTACT_INSIDE 1e-12 /* least distance 1 - |u|^2 of friction from its limit with a barrier .. */
#define CONTACT_NEARER 0.1 /* .. and ratio of those from 1 down to it */
#define CONTACT_CENTRED 1e-12 /* relative descent of the barrier at which its minimum is found */
#define CONTACT_DEPENDENT 1e-12 /* part of a column below which a pivot counts as 0 */

/* Reduces the rows (A, b) by elimination with the pivots on the diagonal that are independent of those before but for
 * rounding, so that their rows and columns are: of nearly dependent ones the small pivots come last. Returns the number
 * of others. */
static int eliminate_rows(real (*line)[CONTACT_ROWS + 1], int count, int *independent)
{
  int others = count;
  memset(independent, 0, (size_t)count * sizeof *independent);
  for (int level = 1; others > 0 && level <= CONTACT_LEVELS; level++)
    for (int i = 0; i < count; i++) {
      const real least = pow(CONTACT_DEPENDENT, level / (real)CONTACT_LEVELS);
      real size = 0.0;
      for (int r = 0; r < count && !independent[i]; r++)
        size = fmax(size, fabs(line[r][i]));
      if (independent[i] || !(fabs(line[i][i]) > least * size))
        continue;
      independent[i] = 1;
      others--;
      for (int r = 0; r < count; r++) {
        const real factor = line[r][i] / line[i][i];
        for (int j = 0; r != i && j <= count; j++)
          line[r][j] -= j == count || !independent[j] || j == i ? factor * line[i][j] : 0.0;
      }
    }
  return others;
}

/* Moves a solution of dependent columns along their null vectors to that of the least sum of weight x^2; the number of
 * these vectors. */
static int reduce_norm(real (*line)[CONTACT_ROWS + 1], int count, const int *independent, const real *weight, real *x,
    real (*null)[CONTACT_ROWS])
{
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
  return found;
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

/* Unknown forces of modes, of which the imposed rows count: their rows, contacts whose friction they are (-1: none),
 * and forces of the rows by them as columns. Sliding without a gap is not among them: `force`, which is 0 otherwise. */
typedef struct {
  int count, row[CONTACT_ROWS], owner[CONTACT_ROWS];
  real column[CONTACT_ROWS][CONTACT_ROWS];
} contact_unknowns;

static void find_unknowns(const contact_terms *of, const contact_mode *mode, contact_unknowns *in, real *force)
{
  memset(in, 0, sizeof *in);
  memset(force, 0, BYTES(CONTACT_ROWS));
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const contact_places *at = CONTACTS + k;
    real *const sliding = at->normal < 0 ? force : in->column[in->count];
    for (int i = 0; i < at->slips; i++)
      sliding[at->tangential + i] = -of->coefficient[3 * k] * mode[k].direction[i];
    if (at->normal >= 0 && mode[k].closed) {
      in->row[in->count] = at->normal;
      in->owner[in->count] = -1;
      in->column[in->count++][at->normal] = 1.0;
    }
    for (int i = 0; i < at->slips; i++)
      if (mode[k].sticks >> i & 1) {
        in->row[in->count] = at->tangential + i;
        in->owner[in->count] = k;
        in->column[in->count++][at->tangential + i] = 1.0;
      }
  }
}

/* Reduces the equations of the unknowns, the rates right + W f of the imposed rows; the number of dependent ones. */
static int reduce_equations(const contact_terms *of, const contact_unknowns *in, const real *right, const real *force,
    real (*matrix)[CONTACT_ROWS + 1], int *independent)
{
  for (int i = 0; i < in->count; i++) {
    const real *W = of->W + in->row[i] * CONTACT_ROWS;
    for (int j = 0; j < in->count; j++)
      matrix[i][j] = 0.0;
    for (int r = 0; r < CONTACT_ROWS; r++)
      for (int j = 0; j < in->count; j++)
        matrix[i][j] += W[r] * in->column[j][r];
    matrix[i][in->count] = -rate_after(of, right, force, in->row[i]);
  }
  return eliminate_rows(matrix, in->count, independent);
}

/* Largest of some rates, and of those by moved forces, relative to the terms of right + W f, of given sizes at least,
 * with the bounds sqrt(W_rr W_jj) of abs(W_rj): entries that cancel, as of slips at rest with normal forces, have the
 * rounding of these. */
static real discord_of(const contact_terms *of, const real *rates, const real *moved, const real *right,
    const real *sizes, const real *force)
{
  const real still[CONTACT_ROWS] = {0.0};
  real largest = 0.0;
  for (int r = 0; r < CONTACT_ROWS; r++) {
    real size = fmax(fabs(right[r]), sizes[r]);
    for (int j = 0; j < CONTACT_ROWS; j++)
      size += sqrt(of->W[r * (CONTACT_ROWS + 1)] * of->W[j * (CONTACT_ROWS + 1)]) * fabs(force[j]);
    largest = fmax(largest, fmax(fabs(rates[r]), fabs(rate_after(of, still, moved, r))) / fmax(size, DBL_MIN));
  }
  return largest;
}

/* Sum over friction of L B(u), u = f / L, and over normal forces of N^2 / load: convex in both. B = -log z with
 * z = 1 - |u|^2, for z < `least` its extension by a parabola (J. Hauser & A. Saccon, Proc. 45th IEEE Conf. Decis.
 * Control, 2006). Also the equations of Newton's method along null vectors, and the smallest z. */
static real state_barrier(const contact_terms *of, const contact_unknowns *in, real (*null)[CONTACT_ROWS], int vectors,
    const real *x, real load, real least, real (*line)[CONTACT_ROWS + 1], real *smallest)
{
  real force[CONTACT_ROWS] = {0.0}, d[2][CONTACT_ROWS] = {{0.0}}, along[CONTACT_ROWS], sum = 0.0;
  int next;
  *smallest = INFINITY;
  for (int i = 0; i < in->count; i++)
    force[in->row[i]] = x[i];
  for (int e = 0; e < vectors; e++)
    memset(line[e], 0, sizeof *line);
  for (int i = 0; i < in->count; i = next) {
    const int k = in->owner[i];
    const real bound = k < 0 ? load : friction_limit(of, k, 1, force), limit = fmax(bound, CONTACT_SLOW * load);
    const real growth = k < 0 || CONTACTS[k].normal < 0 || bound < limit ? 0.0 : of->coefficient[3 * k + 1];
    real u[2] = {0.0}, slope = -1.0, bend = 0.0;
    for (next = i; next == i || (k >= 0 && next < in->count && in->owner[next] == k); next++)
      u[next - i] = x[next] / limit;
    const real z = 1.0 - u[0] * u[0] - u[1] * u[1], beyond = z / least - 2.0;
    real value = 1.0 - z;
    if (k >= 0) {
      value = z < least ? 0.5 * (beyond * beyond - 1.0) - log(least) : -log(z);
      slope = z < least ? beyond / least : -1.0 / z;
      bend = pow(fmax(z, least), -2.0);
      *smallest = fmin(*smallest, z);
    }
    for (int e = 0; e < vectors; e++) {
      const real grows = growth > 0.0 ? growth * null[e][i - 1] : 0.0; /* of the limit, by the normal force */
      along[e] = 0.0;
      for (int j = i; j < next; j++) {
        d[j - i][e] = null[e][j] - u[j - i] * grows;
        along[e] += u[j - i] * d[j - i][e];
      }
      line[e][vectors] += 2.0 * slope * along[e] - grows * value;
    }
    for (int e = 0; e < vectors; e++)
      for (int c = 0; c < vectors; c++)
        for (int j = 0; j < next - i; j++)
          line[e][c] += (4.0 * bend * along[e] * along[c] / (next - i) - 2.0 * slope * d[j][e] * d[j][c]) / limit;
    sum += limit * value;
  }
  return sum;
}

/* Moves forces along null vectors of dependent rows to the centre of those within the limits of friction, by Newton's
 * method: least norm, relative to the limits, for small loads; there is none at the load at which slip begins (theorems
 * of limit analysis), where all friction that slips reaches its limit. What exceeds it beyond that is least. */
static void centre_forces(const contact_terms *of, const contact_unknowns *in, real (*null)[CONTACT_ROWS], int vectors,
    real load, real (*line)[CONTACT_ROWS + 1], real *x)
{
  real trial[CONTACT_ROWS], step[CONTACT_ROWS], slope[CONTACT_ROWS], smallest = -INFINITY;
  int independent[CONTACT_ROWS];
  for (real least = 1.0; least > CONTACT_INSIDE && smallest < least / CONTACT_NEARER; least *= CONTACT_NEARER) {
    real sum = state_barrier(of, in, null, vectors, x, load, least, line, &smallest), descent = INFINITY, part = 1.0;
    for (int i = 0; i < CONTACT_DESCENTS && part > CONTACT_EXACT && descent > CONTACT_CENTRED * load; i++) {
      descent = 0.0;
      for (int e = 0; e < vectors; e++)
        slope[e] = line[e][vectors];
      eliminate_rows(line, vectors, independent);
      for (int e = 0; e < vectors; e++) {
        step[e] = independent[e] ? line[e][vectors] / line[e][e] : 0.0;
        descent += slope[e] * step[e];
      }
      real next = INFINITY;
      for (part = 2.0; part > CONTACT_EXACT && !(next <= sum - 1e-4 * part * descent);) {
        part *= 0.5;
        for (int r = 0; r < in->count; r++) {
          trial[r] = x[r];
          for (int e = 0; e < vectors; e++)
            trial[r] += part * step[e] * null[e][r];
        }
        next = state_barrier(of, in, null, vectors, trial, load, least, line, &smallest);
      }
      if (next < sum)
        memcpy(x, trial, (size_t)in->count * sizeof *x);
      sum = next;
    }
  }
}

/* Solves for the forces of the rows in given modes with after = right + W f = 0 in imposed rows, those in the centre
 * of the friction limits if these are dependent. Returns by how much they contradict each other, or such forces differ
 * in the rates, relative to these, whose terms have given sizes at least. If `imposed` is not NULL, it becomes 1 for
 * rows to impose, which are independent. */
static real solve_rows(const contact_terms *of, const contact_mode *mode, const real *right, const real *sizes,
    real *force, real *after, int *imposed)
{
  contact_unknowns in;
  real matrix[CONTACT_ROWS][CONTACT_ROWS + 1], null[CONTACT_ROWS][CONTACT_ROWS];
  real x[CONTACT_ROWS], least[CONTACT_ROWS], moved[CONTACT_ROWS] = {0.0}, left[CONTACT_ROWS] = {0.0};
  real weight[CONTACT_ROWS] = {0.0}, load = DBL_MIN;
  int independent[CONTACT_ROWS];
  find_unknowns(of, mode, &in, force);
  const int count = in.count, dependent = reduce_equations(of, &in, right, force, matrix, independent);
  for (int i = 0; i < count; i++) {
    least[i] = x[i] = independent[i] ? matrix[i][count] / matrix[i][i] : 0.0;
    weight[i] = 1.0;
  }
  if (dependent) {
    reduce_norm(matrix, count, independent, weight, least, null);
    for (int i = 0; i < count; i++) {
      moved[in.row[i]] = least[i];
      load = fmax(load, fabs(least[i]));
    }
    for (int i = 0; i < count; i++) /* forces may all be 0 */
      weight[i] = in.owner[i] < 0 ? 1.0 : load / fmax(friction_limit(of, in.owner[i], 1, moved), CONTACT_SLOW * load);
    const int vectors = reduce_norm(matrix, count, independent, weight, least, null);
    centre_forces(of, &in, null, vectors, load, matrix, least);
  }
  memset(moved, 0, sizeof moved);
  for (int i = 0; i < count; i++)
    for (int r = 0; r < CONTACT_ROWS; r++) {
      force[r] += in.column[i][r] * least[i];
      moved[r] += in.column[i][r] * (least[i] - x[i]);
    }
  for (int r = 0; r < CONTACT_ROWS; r++)
    after[r] = rate_after(of, right, force, r);
  for (int i = 0; i < count && imposed; i++)
    imposed[in.row[i]] = independent[i];
  for (int i = 0; i < count; i++)
    left[in.row[i]] = after[in.row[i]];
  return dependent ? discord_of(of, left, moved, right, sizes, force) : 0.0;
}

/* The same for second rates. */
static real solve_contacts(const contact_terms *of, const contact_mode *mode, const real *right, real *force,
    real *after, int *imposed)
{
  return solve_rows(of, mode, right, of->second_terms, force, after, imposed);
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
      mode[k].direction[i] = start[-1] * x[i] / length_of(x, 2);
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
  if (status != OK || solve_contacts(&of, mode, of.second, force, after, NULL) > CONTACT_OUTSIDE)
    memset(force, 0, BYTES(CONTACT_ROWS));
  return status;
}

int NAME(contact_forces)(real t, const real *q, const real *p, const real *parameters, real *force, real *workspace)
{
  contact_mode mode[EVENT_CONTACTS];
  return forces_at(t, q, p, parameters, mode, force, workspace);
}

/* Multipliers and parameters for the functions of transitions: of dependent contacts those in the centre, and
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
