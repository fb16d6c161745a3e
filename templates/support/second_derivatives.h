/* Second derivatives of a step by forward-over-reverse differentiation: the tangent of the adjoint. The stage equations
 * times the adjoint multipliers are a function of the inputs and the unknowns; its Hessian times a tangent vector is
 * the source of the tangents of the multipliers, which are solved for with the same factors. Requires: push_and_pull.h,
 * kernels of second derivatives, BENT_ARGUMENTS, BENT_VALUES. */

/* Memory for WIDTH tangent and adjoint vectors. Tangent vectors of the inputs (change) and of the unknowns (dz);
 * adjoint variables (slopes), their tangents (slope_changes), and the contributions of the nonlinear terms with respect
 * to inputs (by_given) and unknowns (by_dz); at the points of a stage group, arguments and results: tangents, adjoint
 * variables, and tangents of these. Last, the arguments u. */
typedef struct {
  wide *change, *dz, *slopes, *slope_changes, *by_given, *by_dz;
  wide *moved, *pulled, *bent;
  real *u;
} bending;

static bending bending_in(const linearised_step *at)
{
  bending to;
  to.change = at->points + MOST_AT_POINTS;
  to.slopes = to.change + GIVEN;
  to.slope_changes = to.slopes + GIVEN;
  to.by_given = to.slope_changes + GIVEN;
  to.dz = to.by_given + GIVEN;
  to.by_dz = to.dz + N;
  to.moved = to.by_dz + N;
  to.pulled = to.moved + MOST_AT_POINTS;
  to.bent = to.pulled + MOST_AT_POINTS;
  to.u = (real *)(to.bent + MOST_AT_POINTS);
  return to;
}

/* sum += factor x y, lane by lane. */
static inline void add_product(wide *sum, real factor, const wide *x, const wide *y)
{
  for (int j = 0; j < WIDTH; j++)
    sum->lane[j] += factor * x->lane[j] * y->lane[j];
}

/* Second derivatives of the kernel at a point for lane j: tangents of the adjoint variables of arguments, and of
 * parameters and time. */
static void bend_lane(const point_family *f, const step_data *step, const bending *to, int n, int j)
{
  const int arguments = f->arguments, results = f->results, parameters = GIVEN - 2 * M - 2;
  const wide *moved = to->moved + n * arguments, *pulled = to->pulled + f->points * arguments + n * results;
  const real c = f->abscissa ? f->abscissa[n] : 0;
  real given[BENT_ARGUMENTS], value[BENT_VALUES], *next = given;
  for (int i = 0; i < arguments; i++)
    *next++ = to->u[n * arguments + i];
  for (int i = 0; i < results; i++)
    *next++ = pulled[i].lane[j];
  for (int i = 0; i < arguments; i++)
    *next++ = moved[i].lane[j];
  for (int i = 0; i < parameters; i++)
    *next++ = to->change[2 * M + i].lane[j];
  *next = to->change[GIVEN_H - 1].lane[j] + c * to->change[GIVEN_H].lane[j];
  f->curvature(given, time_of(f, step, n), step->parameters, value);
  for (int i = 0; i < arguments; i++)
    to->bent[n * arguments + i].lane[j] += value[i];
  for (int i = 0; i <= parameters; i++)
    to->by_given[2 * M + i].lane[j] += value[arguments + i];
  to->by_given[GIVEN_H].lane[j] += c * value[arguments + parameters];
}

/* Contributions of the factor h^power of the results to the tangents of the adjoint variables of the results and of
 * h. */
static void bend_results(const point_family *f, real h, const bending *to, const real *by_h)
{
  const int first = f->points * f->arguments;
  for (int s = 0; s < f->scatters; s++) {
    const real power = (real)f->scatter[s].power;
    for (int n = 0; n < f->points; n++)
      for (int i = 0; i < f->scatter[s].sites; i++) {
        const int k = n * f->results + f->scatter[s].offset + i;
        const wide *dh = to->change + GIVEN_H, *pulled = to->pulled + first + k;
        add_product(to->bent + first + k, power / h, pulled, dh);
        add_product(to->by_given + GIVEN_H, power / h, pulled, to->moved + first + k);
        add_product(to->by_given + GIVEN_H, -(power + 1) * by_h[k] / h, pulled, dh);
      }
  }
}

/* Contributions of arguments, q0 plus h^power times unknowns, to the tangents of the adjoint variables of h and of the
 * arguments. */
static void bend_arguments(const point_family *f, real h, const bending *to, const real *by_h)
{
  const wide *dh = to->change + GIVEN_H;
  wide *by = to->by_given + GIVEN_H;
  for (int g = 0; g < f->gathers; g++) {
    const linear_loop *loop = f->gather + g;
    const real power = (real)loop->power;
    for (int n = 0; n < f->points; n++)
      for (int i = 0; i < loop->sites; i++) {
        const int k = n * f->arguments + loop->offset + i;
        add_product(by, power / h, to->pulled + k, to->moved + k);
        if (loop->from_state)
          add_product(by, -power / h, to->pulled + k, to->change + i);
        add_product(by, -by_h[k] / h, to->pulled + k, dh);
        add_product(to->bent + k, power / h, to->pulled + k, dh);
      }
  }
}

/* Contributions of a stage group. Returns the end of its derivatives. */
static const real *bend_family(const point_family *f, const linearised_step *at, const bending *to, const real *slopes)
{
  const real h = at->step->h, *by_h = slopes + f->points * f->arguments, *slope = by_h + f->points * f->results;
  const real *given = slope + f->points * f->slopes;
  const int first = f->points * f->arguments;
  memset(to->moved, 0, sizeof(wide) * 3 * MOST_AT_POINTS);
  arguments_wide(f, h, 0, slopes, to->change, to->dz, to->moved);
  multiply_wide(f, 0, slope, to->moved, to->moved + first);
  given_wide(f, 0, by_h, given, to->change, to->moved + first);
  scatter_wide(f, h, at->growth, 1, 0, to->pulled + first, at->rows);
  multiply_wide(f, 1, slope, to->pulled, to->pulled + first);
  if (f->curvature)
    arguments_of(f, at->step, at->data.z, to->u);
  for (int n = 0; f->curvature && n < f->points; n++)
    for (int j = 0; j < WIDTH; j++)
      bend_lane(f, at->step, to, n, j);
  bend_results(f, h, to, by_h);
  multiply_wide(f, 1, slope, to->bent, to->bent + first);
  given_wide(f, 1, by_h, given, to->by_given, to->bent + first);
  start_wide(f, 1, slopes, to->by_given, to->bent);
  bend_arguments(f, h, to, slopes);
  gather_wide(f, h, 1, to->by_dz, to->bent);
  return given + f->points * f->given;
}

/* Contributions of q1 = q0 + h (sum of unknowns). */
static void bend_end_position(const bending *to)
{
  for (int i = 0; i < M; i++)
    for (int b = 0; b < B; b++) {
      add_product(to->by_dz + i * B + b, END_POSITION[b], to->slopes + i, to->change + GIVEN_H);
      add_product(to->by_given + GIVEN_H, END_POSITION[b], to->slopes + i, to->dz + i * B + b);
    }
}

/* Replaces slopes and slope_changes, of (q1, p1, parameters, t + h, h), by those of (q0, p0, parameters, t, h). */
static void bend_step(const linearised_step *at, const bending *to)
{
  const real *slopes = at->slopes;
  memcpy(at->v, to->change, sizeof(wide) * GIVEN);
  push_step(at);
  memcpy(to->dz, at->dz, sizeof(wide) * N);
  memcpy(at->v, to->slopes, sizeof(wide) * GIVEN);
  pull_step(at);
  memset(to->by_given, 0, sizeof(wide) * GIVEN);
  memset(to->by_dz, 0, sizeof(wide) * N);
  for (int f = 0; f < COUNT_OF_FAMILIES; f++)
    slopes = bend_family(FAMILIES + f, at, to, slopes);
  bend_end_position(to);
  memcpy(to->slopes, at->v, sizeof(wide) * GIVEN);
  memcpy(at->v, to->slope_changes, sizeof(wide) * GIVEN);
  memcpy(at->dz, to->by_dz, sizeof(wide) * N);
  pull_on(at);
  for (int i = 0; i < GIVEN; i++)
    flow(0, at->v + i, 1, to->by_given + i);
  memcpy(to->slope_changes, at->v, sizeof(wide) * GIVEN);
}

static void read_lanes(wide *to, int own, const real *from)
{
  memset(to, 0, sizeof(wide) * GIVEN);
  for (int j = 0; j < own; j++)
    for (int i = 0; i < GIVEN; i++)
      to[i].lane[j] = from[j * GIVEN + i];
}

static void add_lanes(const wide *from, int own, real *to)
{
  for (int j = 0; j < own; j++)
    for (int i = 0; i < GIVEN; i++)
      to[j * GIVEN + i] += from[i].lane[j];
}

/* Adds to (2, count, GIVEN) adjoint vectors and their tangents `to` the result of the step for `from`, WIDTH at a
 * time. */
static int bend_over(const linearised_step *at, int count, const real *changes, const real *from, real *to)
{
  const bending of = bending_in(at);
  for (int first = 0; first < count; first += WIDTH) {
    const int own = least(WIDTH, count - first), here = first * GIVEN, beside = (count + first) * GIVEN;
    read_lanes(of.change, own, changes + here);
    read_lanes(of.slopes, own, from + here);
    read_lanes(of.slope_changes, own, from + beside);
    bend_step(at, &of);
    add_lanes(of.slopes, own, to + here);
    add_lanes(of.slope_changes, own, to + beside);
  }
  return all_finite(to, 2 * count * GIVEN) ? OK : NOT_FINITE;
}

int NAME(bend)(long long steps, const real *t, const real *h, const real *q, const real *p, const real *parameters,
    const solver_options *options, int count, const real *changes, real *vectors, solver_report *report,
    real *workspace)
{
  const solver_options standard = NAME(default_options)();
  const real carry[M] = {0};
  const long long across = (long long)count * GIVEN;
  memset(report, 0, sizeof *report);
  for (long long k = steps - 1; k >= 0; k--) {
    const step_data step = {t[k], h[k], q + k * M, p + k * M, carry, carry, parameters, workspace, 1, NULL};
    linearised_step at = linearised_in(&step, workspace);
    int status;
    report->t = t[k];
    status = linearise_step(&at, options ? options : &standard, NULL, NULL, report);
    if (status == OK)
      status = bend_over(&at, count, changes + k * across, vectors + (k + 1) * 2 * across, vectors + k * 2 * across);
    if (status != OK)
      return status;
    report->steps++;
  }
  return OK;
}
