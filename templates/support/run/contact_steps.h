#include "contact_places.h"

/* Contacts by steps: runs of fixed steps without transitions, two contact problems in each, for svi:1 on two Lobatto
 * points, Ld(q0, q1) = h/2 (L(q0, v) + L(q1, v)), v = (q1 - q0) / h. With the rows G0, G1 of gaps g and slips at its
 * ends
 *
 *   p0 + G0^T f1 = -D1 Ld(q0, q1),   rates (g(q1) / h, (G0 + G1)/2 (q1 - q0) / h)   [positions]
 *   p1 = D2 Ld(q0, q1) + G1^T f2,    rates G1 M1^-1 p1                             [velocities]
 *
 * (RATTLE with contacts: J. Breuling, G. Capobianco, S. Eugster & R. Leine 2024; gaps / h: M. Anitescu & F. Potra,
 * Nonlinear Dyn. 14, 1997). What rests does not creep, gaps are not negative, and the second problem creates no kinetic
 * energy. Requires: terms_of_steps.h. */
enum {
  STEP_ITERATIONS = 30, /* of the first problem */
  STEP_PARTS = 256, /* the most into which halvings divide a step */
  STEP_POINTS = 30, /* proximal points of a contact problem, after which forces have a compliance */
  STEP_FIXED = CONTACT_FIRST_ROW, /* constraints, whose forces are free */
  STEP_ROWS = STEP_FIXED + ALL_CONTACT_ROWS,
  STEP_SIZE = M + STEP_FIXED
};

#define STEP_UPDATE 1e-6 /* last update relative to the motion in a step: the error that is left is about its square */
#define STEP_SLOW_UPDATE 1e-9 /* the same, where updates converge linearly */
#define STEP_YIELDS 0.1 /* part of its W with M0 below which a row hardly yields to its own force */

typedef NAME(contact_memory) contact_memory;

/* Momenta L_v, forces L_q + f, L_vv, L_vq and f_v by rows: (L_q + f)_v = L_vq^T + f_v. */
typedef struct {
  real momentum[M], force[M], mass[M][M], mixed[M][M], damping[M][M];
} motion_terms;

/* Values of all rows, rates at rest, and G; coefficients of the contacts. */
typedef struct {
  real value[STEP_ROWS], drift[STEP_ROWS], G[STEP_ROWS][M], coefficient[EVENT_CONTACTS][3];
} row_terms;

/* Factors of [A, -G^T; G, 0] with the rows of constraints. */
typedef struct {
  real matrix[STEP_SIZE * STEP_SIZE], pivot[STEP_SIZE];
} step_matrix;

/* Responses A^-1 G0^T, M0^-1 G0^T or M1^-1 G1^T to the first `count` rows of a problem, a column for each. */
typedef struct {
  int count;
  real x[STEP_SIZE][CONTACT_ROWS];
} responses;

/* Forces of all rows that solve a problem, and modes of contacts: 0 open, 1 sticks, 2 slips. */
typedef struct {
  real force[STEP_ROWS], mode[EVENT_CONTACTS];
} step_solution;

/* A step, or part of one, of length h from (t, q, p, v) to q1, and the solutions of its problems; of velocities that
 * with restitution if the step has a part of it, and the factor by which they shrank (strict energy). A problem has the
 * near contacts alone, in the order in which they join: `contact` and `row` are their numbers among all. */
typedef struct {
  real t, h, q[M], p[M], v[M], q1[M], fastest, curvature;
  const real *idle, *imposed; /* parameters */
  motion_terms first, last;
  row_terms start, end;
  step_matrix moving, resting;
  int solved, continues; /* whether `moving` has the masses at q1, and `resting` had at its start */
  int is_full; /* 1 + the contact that found no room, else 0 */
  int exists[EVENT_CONTACTS], is_near[EVENT_CONTACTS], has_begun[EVENT_CONTACTS];
  step_solution positions, velocities;
  real part, factor;
  int contact[EVENT_CONTACTS], row[CONTACT_ROWS], former[CONTACT_ROWS]; /* rows of the last solved step */
  contact_places place[EVENT_CONTACTS];
  responses response, at_start;
  real W[CONTACT_ROWS * CONTACT_ROWS];
  cone_problem problem;
} contact_step;

static real times_row(const real *row, const real *x)
{
  real sum = 0.0;
  for (int i = 0; i < M; i++)
    sum += row[i] * x[i];
  return sum;
}

/* Factorises [A, -G_f^T; G, 0] of M rows A, or L_vv of `of` if they are NULL. */
static int factorise_step(const real (*A)[M], const motion_terms *of, const row_terms *forces, const row_terms *rows,
    step_matrix *to)
{
  const band shape = band_within(STEP_SIZE, STEP_SIZE);
  memset(to->matrix, 0, sizeof to->matrix);
  for (int i = 0; i < M; i++)
    for (int j = 0; j < M; j++)
      to->matrix[j * STEP_SIZE + i] = A ? A[i][j] : of->mass[i][j];
  for (int c = 0; c < STEP_FIXED; c++)
    for (int i = 0; i < M; i++) {
      to->matrix[(M + c) * STEP_SIZE + i] = -forces->G[c][i];
      to->matrix[i * STEP_SIZE + M + c] = rows->G[c][i];
    }
  return factorise(to->matrix, &shape, to->pivot) ? OK : SINGULAR;
}

static void solve_step(const step_matrix *of, real *x)
{
  const band shape = band_within(STEP_SIZE, STEP_SIZE);
  back_substitute(of->matrix, &shape, of->pivot, x);
}

/* Responses to the rows of a problem: all columns at a time. */
static void respond(const contact_step *in, const step_matrix *of, const row_terms *rows, responses *to)
{
  real(*const x)[CONTACT_ROWS] = to->x;
  to->count = in->problem.rows;
  for (int i = 0; i < STEP_SIZE; i++)
    for (int c = 0; c < to->count; c++)
      x[i][c] = i < M ? rows->G[in->row[c]][i] : 0.0;
  for (int k = 0; k < STEP_SIZE; k++) {
    real *const exchanged = x[(int)of->pivot[k]];
    for (int c = 0; c < to->count; c++) {
      const real kept = exchanged[c];
      exchanged[c] = x[k][c];
      x[k][c] = kept;
    }
    for (int i = k + 1; i < STEP_SIZE; i++)
      subtract(x[k], of->matrix[k * STEP_SIZE + i], 0, to->count, x[i]);
  }
  for (int k = STEP_SIZE - 1; k >= 0; k--) {
    for (int c = 0; c < to->count; c++)
      x[k][c] *= of->matrix[k * (STEP_SIZE + 1)];
    for (int i = 0; i < k; i++)
      subtract(x[k], of->matrix[k * STEP_SIZE + i], 0, to->count, x[i]);
  }
}

/* Whether a problem has the rows of that of velocities at the end of the last step. */
static int has_former_rows(const contact_step *in)
{
  const size_t size = sizeof *in->row * (size_t)in->problem.rows;
  return in->response.count == in->problem.rows && memcmp(in->row, in->former, size) == 0;
}

static void keep_responses(const responses *from, responses *to)
{
  to->count = from->count;
  for (int i = 0; i < STEP_SIZE; i++)
    memcpy(to->x[i], from->x[i], BYTES(from->count));
}

/* W of a problem, a part of G times responses; neighbouring sums are of different rows, which no sum waits for. */
static void pose_matrix(contact_step *in, const row_terms *rows, const responses *of, real part)
{
  for (int r = 0; r < of->count; r++)
    memset(in->W + r * CONTACT_ROWS, 0, BYTES(of->count));
  for (int i = 0; i < M; i++)
    for (int r = 0; r < of->count; r++)
      subtract(of->x[i], -part * rows->G[in->row[r]][i], 0, of->count, in->W + r * CONTACT_ROWS);
}

/* Terms at the end, and with `first` at the start and with further derivatives, at the velocity of the step. */
static int terms_between(contact_step *in, int first)
{
  real v[M];
  for (int i = 0; i < M; i++)
    v[i] = (in->q1[i] - in->q[i]) / in->h;
  if (first)
    TRY(NAME(motion_terms)(in->t, in->q, v, in->idle, 1, in->first.momentum));
  TRY(NAME(motion_terms)(in->t + in->h, in->q1, v, in->idle, first, in->last.momentum));
  return NAME(row_terms)(in->t + in->h, in->q1, v, in->imposed, in->end.value);
}

/* A contact joins a problem, from the present impulses and with its friction, static or that of sliding; without a gap
 * half of the step's. */
static int join(contact_step *in, int k, const row_terms *rows, int rests)
{
  cone_problem *const to = &in->problem;
  const int n = to->contacts, first = to->rows;
  const real part = CONTACTS[k].normal < 0 ? 0.5 * in->h : 1.0;
  int row[3];
  const int count = rows_of(CONTACTS + k, row);
  if (first + count > CONTACT_ROWS)
    return in->is_full = k + 1, NOT_CONVERGED;
  for (int i = 0; i < count; i++) {
    in->row[first + i] = STEP_FIXED + row[i];
    to->f[first + i] = in->positions.force[STEP_FIXED + row[i]];
  }
  in->contact[n] = k;
  in->is_near[k] = 1;
  in->place[n] = CONTACTS[k];
  in->place[n].normal = CONTACTS[k].normal < 0 ? -1 : first;
  in->place[n].tangential = first + (CONTACTS[k].normal >= 0);
  to->takes_part[n] = 1;
  to->rests[n] = rests;
  to->mu[n] = part * rows->coefficient[k][0];
  to->mu_static[n] = part * rows->coefficient[k][1];
  to->contacts++;
  to->rows += count;
  return OK;
}

/* A problem without contacts. */
static void clear_problem(contact_step *in)
{
  in->problem.contacts = in->problem.rows = 0;
  in->problem.places = in->place;
  in->problem.W = in->W;
  memset(in->is_near, 0, sizeof in->is_near);
}

/* Change x of q1 without contacts that satisfies the linearised step, in x also the forces of constraints. */
static int linearise_step(contact_step *in, real *x)
{
  real A[M][M];
  for (int i = 0; i < M; i++) {
    x[i] = in->p[i] + 0.5 * (in->h * in->first.force[i] - in->first.momentum[i] - in->last.momentum[i]);
    for (int j = 0; j < M; j++)
      A[i][j] = 0.5 *
          ((in->first.mass[i][j] + in->last.mass[i][j]) / in->h + in->last.mixed[i][j] - in->first.mixed[j][i] -
              in->first.damping[i][j]);
  }
  for (int c = 0; c < STEP_FIXED; c++)
    x[M + c] = -in->end.value[c];
  TRY(factorise_step(A, NULL, &in->start, &in->end, &in->moving));
  solve_step(&in->moving, x);
  return OK;
}

/* Contacts join that have no gap, pushed in the last step, or have a gap within reach after a change x of positions. */
static int find_near(contact_step *in, const contact_memory *from, const real *x, real reach)
{
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const int normal = CONTACTS[k].normal, row = STEP_FIXED + normal;
    if (in->exists[k] && !in->is_near[k] &&
        (normal < 0 || from->pushes[k] || in->end.value[row] + times_row(in->end.G[row], x) < reach))
      TRY(join(in, k, &in->start, from->sticks[k]));
  }
  return OK;
}

/* Constants of the rows of a problem of positions: gaps at the end over the step, and slips along it. */
static void pose_positions(contact_step *in, const real *x)
{
  cone_problem *const of = &in->problem;
  for (int k = 0; k < of->contacts; k++) {
    int row[3];
    for (int i = rows_of(in->place + k, row) - 1; i >= 0; i--) {
      const int r = row[i], all = in->row[r], is_gap = r == in->place[k].normal;
      real b = is_gap ? in->end.value[all] : 0.0;
      for (int m = 0; m < M; m++)
        b += in->end.G[all][m] * x[m] +
            (is_gap ? 0.0 : 0.5 * (in->start.G[all][m] + in->end.G[all][m]) * (in->q1[m] - in->q[m]));
      of->b[r] = b / in->h + (is_gap ? 0.0 : 0.5 * (in->start.drift[all] + in->end.drift[all]));
      of->terms[r] = fabs(of->b[r]);
    }
  }
}

/* Rates b + W f of the first problem at a change x, at first static friction where slips rest; *slow: whether a row
 * yields little to its own force at the end, so that W is that of the start. */
static int solve_positions(contact_step *in, const contact_memory *from, const real *x, int first, int *slow)
{
  cone_problem *const of = &in->problem;
  const responses *const at = &in->at_start;
  real force[CONTACT_ROWS];
  memcpy(force, of->f, BYTES(of->rows));
  if (first && in->continues && has_former_rows(in))
    keep_responses(&in->response, &in->at_start);
  else if (first || at->count != of->rows) /* contacts only join */
    respond(in, &in->resting, &in->start, &in->at_start);
  respond(in, &in->moving, &in->start, &in->response);
  pose_matrix(in, &in->end, &in->response, 1.0 / in->h);
  *slow = 0;
  for (int r = 0; r < of->rows; r++) {
    real yields = 0.0;
    for (int i = 0; i < M; i++)
      yields += in->start.G[in->row[r]][i] * at->x[i][r];
    *slow |= in->W[r * (CONTACT_ROWS + 1)] < STEP_YIELDS * yields;
  }
  pose_positions(in, x);
  if (*slow) { /* b + W f of the present forces stays */
    for (int r = 0; r < of->rows; r++)
      of->b[r] = cone_rate(of, r);
    pose_matrix(in, &in->start, at, 1.0);
    for (int r = 0; r < of->rows; r++)
      for (int c = 0; c < of->rows; c++)
        of->b[r] -= in->W[r * CONTACT_ROWS + c] * force[c];
  }
  if (!solve_cone_within(of, STEP_POINTS))
    return NOT_CONVERGED;
  int reverses = 0;
  for (int k = 0; k < of->contacts && first; k++) { /* which stop in between have static friction */
    const real *const now = of->mode[k].direction, *const before = from->direction[in->contact[k]];
    const int turns = in->place[k].slips > 0 && !of->rests[k] && !of->mode[k].sticks && of->mu_static[k] > of->mu[k] &&
        now[0] * before[0] + now[1] * before[1] < 0.0;
    of->rests[k] |= turns;
    reverses |= turns;
  }
  return !reverses || solve_cone_within(of, STEP_POINTS) ? OK : NOT_CONVERGED;
}

/* Norm of a change of positions in the metric of the masses at the start. */
static real norm_of(const contact_step *in, const real *x)
{
  real sum = 0.0;
  for (int i = 0; i < M; i++)
    for (int j = 0; j < M; j++)
      sum += x[i] * in->first.mass[i][j] * x[j];
  return sqrt(fmax(sum, 0.0));
}

/* Rate of a row at a state. */
static real rate_of(const row_terms *rows, int row, const real *v)
{
  return times_row(rows->G[row], v) + rows->drift[row];
}

/* Limits of friction, which the first solution of a problem chooses, for its further ones. */
static void keep_limits(contact_step *in, const contact_memory *from)
{
  for (int k = 0; k < in->problem.contacts; k++) {
    in->has_begun[in->contact[k]] = from->sticks[in->contact[k]] && !in->problem.is_static[k];
    in->problem.mu[k] = cone_limit(&in->problem, k);
    in->problem.rests[k] = 0;
  }
}

/* Whether the contacts that push are those of the last step, whose equations have the curvature of this one. */
static int pushes_as_before(const contact_step *in, const contact_memory *from)
{
  int same = 1;
  for (int k = 0; k < in->problem.contacts; k++)
    same &= in->place[k].normal < 0 || in->problem.mode[k].pushes == from->pushes[in->contact[k]];
  return same;
}

/* y += part X f with responses X. */
static void add_responses(const responses *of, real part, const real *f, real *y)
{
  for (int i = 0; i < M; i++)
    for (int c = 0; c < of->count; c++)
      y[i] += part * of->x[i][c] * f[c];
}

/* Notes a solution with x, of which x[M ..] are the forces of constraints without contacts. */
static void note_solution(const contact_step *in, const real *x, step_solution *to)
{
  const cone_problem *const of = &in->problem;
  memset(to, 0, sizeof *to);
  for (int c = 0; c < STEP_FIXED; c++) {
    to->force[c] = x[M + c];
    for (int r = 0; r < of->rows; r++)
      to->force[c] += in->response.x[M + c][r] * of->f[r];
  }
  for (int r = 0; r < of->rows; r++)
    to->force[in->row[r]] = of->f[r];
  for (int k = 0; k < of->contacts; k++)
    if (in->place[k].normal < 0 || of->mode[k].pushes)
      to->mode[in->contact[k]] = of->mode[k].sticks && cone_limit(of, k) > 0.0 ? 1.0 : 2.0;
}

/* Solves the first problem for q1 and the impulses f1: Newton's method on both, a contact problem an iteration. */
static int find_positions(contact_step *in, const contact_memory *from)
{
  const real still[M] = {0.0};
  real size = 0.0, before = 0.0;
  clear_problem(in);
  memset(in->has_begun, 0, sizeof in->has_begun);
  for (int r = 0; r < ALL_CONTACT_ROWS; r++)
    in->positions.force[STEP_FIXED + r] = in->h * from->force[r];
  for (int i = 0; i < M; i++) {
    const real bend = (from->steady > 0 ? from->bend[i] : 0.0) + (from->steady > 1 ? from->turn[i] : 0.0);
    in->q1[i] = in->q[i] + in->h * (in->v[i] + in->h * bend);
  }
  in->curvature = from->steady > 0 ? 2.0 * from->curvature : 0.0; /* as it may grow until it is measured again */
  for (int iteration = 0; iteration < STEP_ITERATIONS; iteration++) {
    real x[STEP_SIZE], rounding[M];
    int slow;
    TRY(terms_between(in, 1));
    if (iteration == 0 && !in->continues)
      TRY(factorise_step(NULL, &in->first, &in->start, &in->start, &in->resting));
    TRY(linearise_step(in, x));
    TRY(find_near(in, from, x, in->h * in->fastest));
    for (int i = 0; i < M; i++)
      rounding[i] = in->h * in->v[i];
    size = iteration == 0 ? STEP_UPDATE * (norm_of(in, rounding) + norm_of(in, x)) : size;
    TRY(solve_positions(in, from, x, iteration == 0, &slow));
    if (iteration == 0)
      keep_limits(in, from);
    add_responses(&in->response, 1.0, in->problem.f, x);
    for (int i = 0; i < M; i++) {
      in->q1[i] += x[i];
      rounding[i] = CONTACT_LOWEST * DBL_EPSILON * fabs(in->q1[i]);
    }
    const real update = norm_of(in, x), smallest = norm_of(in, rounding);
    if (iteration == 1)
      in->curvature = update / fmax(before * before, DBL_MIN);
    before = update;
    if (!(update <= (slow ? STEP_SLOW_UPDATE / STEP_UPDATE : 1.0) * size + smallest) &&
        !(iteration == 0 && in->curvature > 0.0 && !slow && in->curvature * update * update <= STEP_UPDATE * size &&
            pushes_as_before(in, from)))
      continue;
    for (int i = 0; i < M; i++) /* L_v is linear in v */
      in->first.momentum[i] += times_row(in->first.mass[i], x) / in->h;
    TRY(terms_between(in, 0));
    const int contacts = in->problem.contacts; /* those join whose gaps only the forces of others close */
    TRY(find_near(in, from, still, 0.0));
    if (contacts == in->problem.contacts) {
      note_solution(in, x, &in->positions);
      return OK;
    }
  }
  return NOT_CONVERGED;
}

/* Kinetic energy v^T M1 v / 2, or half the product of two velocities. */
static real half_product(const contact_step *in, const real *v, const real *w)
{
  real sum = 0.0;
  for (int i = 0; i < M; i++)
    for (int j = 0; j < M; j++)
      sum += 0.5 * v[i] * in->last.mass[i][j] * w[j];
  return sum;
}

/* Work of moving surfaces by impulses f of a problem with the rows of a state. */
static real work_of_surfaces(const contact_step *in, const row_terms *rows, const real *f)
{
  real work = 0.0;
  for (int r = 0; r < in->problem.rows; r++)
    work -= f[r] * rows->drift[in->row[r]];
  return work;
}

/* Kinetic energy at the end of a step with the energy before it. */
static int energy_before(const contact_step *in, const real *v, real *room, real *workspace)
{
  real p[M], energy;
  TRY(NAME(energy)(in->t, in->q, in->p, in->idle, room, workspace));
  TRY(NAME(momentum)(in->t + in->h, in->q1, v, in->idle, p, workspace));
  TRY(NAME(energy)(in->t + in->h, in->q1, p, in->idle, &energy, workspace));
  *room -= energy - half_product(in, v, v);
  return OK;
}

/* Velocities with at most the energy before the step: all of them shrink together. */
static int limit_energy(contact_step *in, real *v, real *workspace)
{
  const real kinetic = half_product(in, v, v);
  real room;
  TRY(energy_before(in, v, &room, workspace));
  room = fmax(room, 0.0);
  const real factor = kinetic > room ? sqrt(room / kinetic) : 1.0;
  for (int i = 0; i < M; i++)
    v[i] *= factor;
  in->factor = factor;
  return OK;
}

/* Restitution of contacts that f1 closed, with rates e times those before the step: v += s (v_e - v) with the largest s
 * in [0, 1] for which the energy is that before at most, with the work of moving surfaces in f1 and here. */
static int rebound(contact_step *in, const contact_memory *from, real by_surfaces, const real *before, real *v,
    real *workspace)
{
  cone_problem *const of = &in->problem;
  const real plastic = work_of_surfaces(in, &in->end, of->f);
  real w[M], room;
  int bounces = 0;
  for (int i = 0; i < of->contacts; i++) {
    const int k = in->contact[i], r = in->place[i].normal;
    if (r < 0 || in->positions.mode[k] == 0.0 || from->is_closed[k])
      continue;
    const real target = in->start.coefficient[k][2] * fmin(rate_of(&in->start, in->row[r], in->v), 0.0);
    of->b[r] += target;
    bounces |= target < 0.0;
  }
  if (!bounces)
    return OK;
  TRY(energy_before(in, v, &room, workspace));
  room += by_surfaces;
  if (!solve_cone_within(of, STEP_POINTS))
    return NOT_CONVERGED;
  memcpy(w, before, BYTES(M));
  add_responses(&in->response, 1.0, of->f, w);
  for (int i = 0; i < M; i++)
    w[i] -= v[i];
  const real square = half_product(in, w, w);
  const real linear = 2.0 * half_product(in, v, w) - work_of_surfaces(in, &in->end, of->f) + plastic;
  const real rest = half_product(in, v, v) - plastic - room;
  in->part = square + linear + rest <= 0.0 ? 1.0
      : rest >= 0.0                        ? 0.0
                    : fmin(1.0, (-linear + sqrt(linear * linear - 4.0 * square * rest)) / (2.0 * square));
  for (int i = 0; i < M; i++)
    v[i] += in->part * w[i];
  if (in->part > 0.0)
    note_solution(in, before, &in->velocities);
  return OK;
}

/* Whether a contact is open, sticks or slips unlike before, or rebounds. */
static int has_changed(const contact_memory *before, const contact_memory *now, int k)
{
  return before->is_closed[k] != now->is_closed[k] || before->sticks[k] != now->sticks[k] ||
      (now->pushes[k] && !now->is_closed[k]);
}

/* Solves the second problem for the velocities at q1, and keeps forces and modes. */
static int find_velocities(contact_step *in, contact_memory *to, real *workspace)
{
  cone_problem *const of = &in->problem;
  const contact_memory from = *to;
  real before[STEP_SIZE], v[M], work = 0.0, fastest = 0.0;
  const real by_surfaces = work_of_surfaces(in, &in->start, of->f);
  int changes = 0;
  memcpy(v, in->v, sizeof v); /* the mean of those before and after f1 */
  add_responses(&in->at_start, 0.5, of->f, v);
  for (int r = 0; r < of->rows; r++)
    work += of->f[r] * times_row(in->start.G[in->row[r]], v);
  for (int i = 0; i < M; i++) {
    before[i] = 0.5 * (in->h * in->last.force[i] + in->first.momentum[i] - in->last.momentum[i]);
    for (int j = 0; j < M; j++)
      before[i] += in->last.mass[i][j] * (in->q1[j] - in->q[j]) / in->h;
  }
  for (int c = 0; c < STEP_FIXED; c++)
    before[M + c] = -in->end.drift[c];
  TRY(factorise_step(NULL, &in->last, &in->end, &in->end, &in->moving));
  solve_step(&in->moving, before);
  clear_problem(in);
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const int normal = CONTACTS[k].normal, row = STEP_FIXED + normal;
    if (in->exists[k] &&
        (normal < 0 || in->positions.mode[k] > 0.0 ||
            in->end.value[row] <= CONTACT_LOWEST * DBL_EPSILON * size_by_position(in->end.G[row], in->q1)))
      TRY(join(in, k, &in->end, from.sticks[k] && !in->has_begun[k]));
  }
  respond(in, &in->moving, &in->end, &in->response);
  pose_matrix(in, &in->end, &in->response, 1.0);
  for (int r = 0; r < of->rows; r++) {
    of->b[r] = rate_of(&in->end, in->row[r], before);
    of->terms[r] = fabs(of->b[r]);
    fastest = fmax(fastest, of->terms[r]);
  }
  to->residual = fmax(to->residual, of->residual);
  to->compliance = fmax(to->compliance, of->compliance);
  if (!solve_cone_within(of, STEP_POINTS))
    return NOT_CONVERGED;
  note_solution(in, before, &in->velocities);
  memcpy(v, before, sizeof v);
  add_responses(&in->response, 1.0, of->f, v);
  TRY(rebound(in, &from, by_surfaces, before, v, workspace));
  if (to->is_strict)
    TRY(limit_energy(in, v, workspace));
  to->residual = fmax(to->residual, of->residual);
  to->compliance = fmax(to->compliance, of->compliance);
  to->lost_energy -= work + half_product(in, v, v) - half_product(in, before, before);
  memcpy(to->v, v, sizeof v);
  for (int r = 0; r < ALL_CONTACT_ROWS; r++)
    to->force[r] = in->positions.force[STEP_FIXED + r] / in->h;
  memcpy(to->exists, in->exists, sizeof to->exists);
  memset(to->is_closed, 0, sizeof to->is_closed);
  memset(to->sticks, 0, sizeof to->sticks);
  memset(to->direction, 0, sizeof to->direction);
  for (int i = 0; i < of->contacts; i++) {
    const int k = in->contact[i], r = in->place[i].normal;
    to->is_closed[k] = r < 0 || rate_of(&in->end, in->row[r], v) <= CONTACT_ROUNDING * fastest;
    to->sticks[k] = to->is_closed[k] && of->mode[i].sticks;
    memcpy(to->direction[k], of->mode[i].direction, sizeof *to->direction);
  }
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    to->pushes[k] = CONTACTS[k].normal >= 0 && in->positions.mode[k] > 0.0;
    changes |= from.pushes[k] != to->pushes[k] || has_changed(&from, to, k);
  }
  for (int i = 0; i < M; i++) {
    to->bend[i] = ((in->q1[i] - in->q[i]) / in->h - in->v[i]) / in->h;
    to->turn[i] = to->bend[i] - from.bend[i];
  }
  to->steady = changes ? 0 : least(from.steady + 1, 2);
  to->curvature = in->curvature;
  return OK;
}

static void take_state(contact_step *in, const contact_memory *memory, real t, real h, const real *q, const real *p)
{
  in->continues = in->solved && t == in->t + in->h && memcmp(q, in->q1, BYTES(M)) == 0;
  if (in->continues)
    in->resting = in->moving;
  in->solved = 0;
  in->part = 0.0;
  in->factor = 1.0;
  in->t = t;
  in->h = h;
  memcpy(in->q, q, BYTES(M));
  memcpy(in->p, p, BYTES(M));
  memcpy(in->v, memory->v, BYTES(M));
}

/* Rows at the start, and contacts whose conditions hold there: those that existed, and those that it is not behind. */
static int find_existing(contact_step *in, const contact_memory *from, real *workspace)
{
  if (in->continues) { /* rows are those at the end of the last step, laws may depend on velocities */
    in->start = in->end;
    TRY(NAME(contact_laws)(in->t, in->q, in->v, in->imposed, in->start.coefficient[0]));
  } else {
    TRY(NAME(row_terms)(in->t, in->q, in->v, in->imposed, in->start.value));
  }
  in->fastest = 0.0;
  for (int r = 0; r < ALL_CONTACT_ROWS; r++)
    in->fastest = fmax(in->fastest, fabs(rate_of(&in->start, STEP_FIXED + r, in->v)));
  for (int k = 0; k < EVENT_CONTACTS; k++)
    in->exists[k] = 1;
  for (int i = 0; i < TRANSITIONS; i++) {
    const int event = FIRST_TRANSITION + i, k = TRANSITION[i][0], row = STEP_FIXED + CONTACTS[k].normal;
    int exists;
    if (TRANSITION[i][1] != CONTACT_CLOSES || !IS_CONDITIONAL[event])
      continue;
    TRY(conditions(EVENT_FIRST[event], in->t, in->q, in->p, in->idle, &exists, workspace));
    in->exists[k] = exists &&
        (from->exists[k] ||
            in->start.value[row] >= -CONTACT_PENETRATION * size_by_position(in->start.G[row], in->q));
  }
  return OK;
}

/* One step, or part, of length h from (t, q, p), which become those at its end. */
static int take_part(contact_step *in, contact_memory *memory, real t, real h, real *q, real *p, real *workspace)
{
  contact_memory next = *memory;
  take_state(in, memory, t, h, q, p);
  TRY(find_existing(in, memory, workspace));
  TRY(find_positions(in, memory));
  TRY(find_velocities(in, &next, workspace));
  for (int i = 0; i < M; i++) { /* L_v is linear in v */
    p[i] = in->last.momentum[i];
    for (int j = 0; j < M; j++)
      p[i] += in->last.mass[i][j] * (next.v[j] - (in->q1[j] - in->q[j]) / h);
  }
  memcpy(q, in->q1, BYTES(M));
  *memory = next;
  memcpy(in->former, in->row, sizeof in->former);
  in->solved = 1;
  return OK;
}

/* The part of a step of length h from t that begins after *done of STEP_PARTS: all that is left of its half, quarter,
 * .., or where that does not converge half of it, and so on. */
static int next_part(contact_step *in, contact_memory *memory, real t, real h, real *q, real *p, int *done,
    real *workspace)
{
  const real unit = h / STEP_PARTS, begin = t + *done * unit;
  int status = NOT_CONVERGED;
  for (int length = *done ? *done & -*done : STEP_PARTS; length > 0; length /= 2) {
    status = take_part(in, memory, begin, length * unit, q, p, workspace);
    if (status == OK) {
      *done += length;
      break;
    }
  }
  return status;
}

/* Modes of contacts as parameters of a run. */
static void put_memory(const contact_memory *memory, real *mode)
{
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    contact_mode now = {memory->is_closed[k], memory->sticks[k] ? 3 : 0, 0, {0.0, 0.0}};
    for (int i = 0; i < 2 && now.closed && !now.sticks; i++)
      now.direction[i] = memory->direction[k][i];
    put_mode(CONTACTS + k, now, AT_REST, 0.0, mode);
  }
}

/* Notes the direction of the slip of contact k at the start of a step, and returns its speed. */
static real note_slip(const contact_step *in, contact_memory *memory, int k)
{
  real w[2] = {0.0};
  for (int i = 0; i < CONTACTS[k].slips; i++)
    w[i] = rate_of(&in->start, STEP_FIXED + CONTACTS[k].tangential + i, memory->v);
  const real speed = length_of(w, 2);
  for (int i = 0; i < 2; i++)
    memory->direction[k][i] = w[i] / fmax(speed, DBL_MIN);
  return speed;
}

/* Velocities of a run at a state, its rows and existing contacts. */
static int find_start(contact_step *in, const event_run *run, contact_memory *memory, real *workspace)
{
  TRY(NAME(velocity)(run->t, run->q, run->p, in->idle, memory->v, workspace));
  take_state(in, memory, run->t, run->h, run->q, run->p);
  TRY(find_existing(in, memory, workspace));
  memcpy(memory->exists, in->exists, sizeof memory->exists);
  return OK;
}

/* Velocities of a run at its start, and slips that rest there. */
static int begin_by_steps(contact_step *in, event_run *run, event_watch *watch, real *workspace)
{
  contact_memory *const memory = &watch->steps;
  TRY(find_start(in, run, memory, workspace));
  for (int k = 0; k < EVENT_CONTACTS; k++) {
    const int normal = CONTACTS[k].normal, row = STEP_FIXED + normal;
    const real size = normal < 0 ? 0.0 : size_by_position(in->start.G[row], run->q);
    const real gap = normal < 0 ? 0.0 : in->start.value[row];
    if (in->exists[k] && gap < -CONTACT_PENETRATION * size) {
      watch->refusal = CONTACT_PENETRATES;
      watch->refused = k + 1;
      watch->behind = gap;
      return NOT_CONVERGED;
    }
    const real speed = note_slip(in, memory, k);
    memory->is_closed[k] = in->exists[k] && gap <= CONTACT_ROUNDING * size;
    memory->sticks[k] = memory->is_closed[k] && CONTACTS[k].slips > 0 && speed <= CONTACT_ROUNDING * in->fastest;
  }
  memory->begun = 1;
  put_memory(memory, watch->mode);
  return OK;
}

/* Adds a crossing at a state. */
static event_crossing *note_crossing(const event_step *step, int function, real fraction, const event_sample *at)
{
  event_crossing *const to = step->found + (*step->filled)++;
  memset(to, 0, sizeof *to);
  to->t = at->t;
  to->fraction = fraction;
  to->function = function;
  copy_state(to->q, to->p, at->q, at->p);
  return to;
}

/* Notes the zeros of the functions of events in a step, linear between its ends; a terminal one ends the run there. */
static int note_events(const event_step *step, event_run *run, const event_sample *left, event_sample *right)
{
  real before[EVENTS], after[EVENTS];
  if (FIRST_TRANSITION == 0)
    return OK;
  TRY(all_values(left->t, left->q, left->p, step->own, before, step->workspace));
  TRY(all_values(right->t, right->q, right->p, step->own, after, step->workspace));
  const long long first = *step->filled;
  for (int e = 0; e < EVENT_FIRST[FIRST_TRANSITION]; e++) {
    const int event = EVENT_OF(e), sign = after[e] >= 0.0 ? 1 : -1;
    real q[M], p[M];
    event_sample at = {.q = q, .p = p};
    if ((before[e] >= 0.0) == (after[e] >= 0.0) || before[e] == 0.0 || step->watch->direction[event] * sign < 0)
      continue;
    const real part = before[e] / (before[e] - after[e]);
    at.t = left->t + part * (right->t - left->t);
    for (int i = 0; i < M; i++) {
      q[i] = left->q[i] + part * (right->q[i] - left->q[i]);
      p[i] = left->p[i] + part * (right->p[i] - left->p[i]);
    }
    event_crossing *const crossing = note_crossing(step, event, part, &at);
    crossing->direction = sign;
    crossing->element = e - EVENT_FIRST[event];
  }
  TRY(settle_crossings(step, first));
  if (step->watch->ended) {
    event_crossing *const end = step->found + *step->filled - 1;
    right->t = end->t;
    copy_state(right->q, right->p, end->q, end->p);
    set_run(run, end->t, right);
  }
  return OK;
}

int NAME(advance_by_steps)(event_run *run, event_watch *watch, real t_end, const step_control *control,
    long long steps, const real *parameters, const solver_options *options, long long states, real *t, real *q, real *p,
    real *length, int *iterations, long long *number, long long room, event_crossing *found, long long *filled,
    solver_report *report, real *workspace)
{
  EVENT_MEMORY(watch, memory, 13 * M)
  contact_step in;
  real idle[PARAMETERS], imposed[PARAMETERS], own[PARAMETERS];
  const stored_states to = {states, number, t, q, p, length, iterations};
  event_sample left = {.q = memory + 9 * M, .p = memory + 10 * M}, right = {.q = memory + 11 * M, .p = memory + 12 * M};
  event_step step = {0.0, 0.0, 0.0, NULL, NULL, own, options, watch, found, room, filled, report, workspace, memory,
      memory + 13 * M, 0, NULL, own};
  (void)control;
  memset(report, 0, sizeof *report);
  memcpy(own, parameters, sizeof own);
  memcpy(idle, parameters, sizeof idle);
  memcpy(imposed, parameters, sizeof imposed);
  put_in_all(CONTACT_IS_OPEN, idle);
  put_in_all(CONTACT_STICKS, imposed);
  memset(&in, 0, sizeof in);
  in.idle = idle;
  in.imposed = imposed;
  *filled = 0;
  report->t = run->t;
  if (!watch->steps.begun)
    TRY(begin_by_steps(&in, run, watch, workspace));
  watch->begun = 1;
  while (report->steps < steps && !watch->ended && (t_end - run->t) - run->t_low != 0.0) {
    const real rest = (t_end - run->t) - run->t_low, h = rest < (1.0 - CHANGE_WHOLE) * run->h ? rest : run->h;
    const contact_memory before = watch->steps;
    int changed = -1;
    if (room - *filled < EVENT_FIRST[FIRST_TRANSITION] + 1 || report->stored == states)
      return OK;
    report->t = left.t = run->t;
    copy_state(left.q, left.p, run->q, run->p);
    copy_state(right.q, right.p, run->q, run->p);
    int status = OK;
    for (int done = 0; done < STEP_PARTS && status == OK;)
      status = next_part(&in, &watch->steps, run->t, h, right.q, right.p, &done, workspace);
    if (status != OK) { /* its first parts may have been solved */
      watch->steps = before;
      watch->refusal = in.is_full ? CONTACT_CROWDS : watch->refusal;
      watch->refused = in.is_full;
      return status;
    }
    set_run(run, run->t, &right);
    if (h == run->h) {
      add_compensated(&run->t, &run->t_low, h, 0.0);
    } else {
      run->t = t_end;
      run->t_low = 0.0;
    }
    run->step++;
    right.t = run->t;
    watch->time += h;
    TRY(note_events(&step, run, &left, &right));
    for (int k = EVENT_CONTACTS - 1; k >= 0; k--)
      changed = has_changed(&before, &watch->steps, k) ? k : changed;
    if (changed >= 0 && !watch->ended) {
      int transition = 0;
      while (TRANSITION[transition][0] != changed)
        transition++;
      event_crossing *const crossing = note_crossing(&step, FIRST_TRANSITION + transition, 1.0, &right);
      crossing->direction = -1;
      crossing->acted = 1;
      memcpy(crossing->mode, watch->mode, sizeof crossing->mode);
      put_memory(&watch->steps, watch->mode);
    }
    TRY(store_state(&to, &right, right.t - left.t, 0, watch->ended ? -1 : run->step, report));
    report->steps++;
  }
  return OK;
}
