/* planar pendulum: Stoermer-Verlet (Lobatto IIIA-IIIB pair of two stages); see pendulum_verlet.h. */
#include "pendulum_verlet.h"

#include <float.h>
#include <math.h>
#include <string.h>

enum {
  M = 1, /* coordinates */
  B = 2, /* blocks of M unknowns */
  N = B * M,
  POINTS = 2, /* most points of a family, or blocks */
  BAND = 0, /* coordinates that meet are at most so many places apart */
  MEMORY = 1, /* numbers kept from step to step */
  SCRATCH = 12 /* arguments, values and slopes at all points, or the mass matrix with its slopes */
};

/* Everything a step is made from. */
typedef struct {
  double t, h;
  const double *q0, *p0, *carry_q, *carry_p, *parameters;
  double *scratch; /* SCRATCH numbers */
  int first; /* whether the workspace holds nothing of the step before */
} step_data;

/* fmax and fmin without their care for NaN, and without a call. */
static inline double larger(double a, double b)
{
  return a > b ? a : b;
}

/* q1 = q0 + h sum_b END_POSITION[b] z_b; row r holds MOMENTUM_ROW[r] p0; the straight-line guess of z_b is STRAIGHT[b]
 * v0. */
static const double END_POSITION[2] = {
  0.5, 0.5
};

static const double MOMENTUM_ROW[2] = {
  0.5, 0.5
};

static const double STRAIGHT[2] = {
  1.0, 1.0
};


/* Quadrature: 2 points.
 * Gather tables have one row a block and one column a point, scatter tables one row a point and one column a row of
 * equations, a last one for p1. */
static const double QUADRATURE_WEIGHT[2] = {
  0.5, 0.5
};

static const double QUADRATURE_GATHER_0[2][2] = {
  {0.0, 0.5},
  {0.0, 0.5}
};

static const double QUADRATURE_GATHER_1[2][2] = {
  {1.0, 0.0},
  {0.0, 1.0}
};

static const double QUADRATURE_SCATTER_0[2][3] = {
  {0.5, 0.5, 1.0},
  {0.0, 0.0, 1.0}
};

static const double QUADRATURE_SCATTER_1[2][3] = {
  {-1.0, 0.0, 0.0},
  {0.0, -1.0, 0.0}
};

static const int QUADRATURE_SLOPE_0[1][2] = { /* {i, j}: d value_i / d u_j */
  {0, 0}
};

static const int QUADRATURE_SLOPE_1[1][2] = { /* {i, j}: d value_i / d u_j */
  {0, 0}
};

/* L_q and L_v at u = (q, v). Operations: 6 *, 1 neg, 1 sin. */
static void quadrature_value(const double *u, const double *parameters, double *value)
{
  value[0] = -(parameters[2]*parameters[1]*parameters[0]*sin(u[0]));
  value[1] = parameters[0]*(parameters[1]*parameters[1])*u[1];
}

/* The same, and the non-zero derivatives with respect to u = (q, v). Operations: 7 *, 1 cos, 2 neg, 1 sin. */
static void quadrature_slope(const double *u, const double *parameters, double *value, double *slope)
{
  const double w0 = parameters[2]*parameters[1]*parameters[0];
  value[0] = -(w0*sin(u[0]));
  slope[0] = -(w0*cos(u[0]));
  const double w1 = parameters[0]*(parameters[1]*parameters[1]);
  value[1] = w1*u[1];
  slope[1] = w1;
}

/* Momenta L_v and mass matrix L_vv at u = (q, v). Operations: 3 *. */
static void legendre(const double *u, const double *parameters, double *value, double *slope)
{
  const double w0 = parameters[0]*(parameters[1]*parameters[1]);
  value[0] = w0*u[1];
  slope[0] = w0;
}

/* L at u = (q, v). Operations: 9 *, 1 +, 1 cos. */
static void lagrangian(const double *u, const double *parameters, double *value)
{
  value[0] = 0.5*(parameters[0]*(parameters[1]*parameters[1])*(u[1]*u[1]) + 2.0*parameters[0]*parameters[1]*parameters[2]*cos(u[0]));
}

/* Place of each coordinate in the order in which those that meet stand near each other. */
static const int PLACE[M] = {
  0
};

/* A square matrix with `blocks` unknowns a coordinate, coordinates in the order of PLACE. Those more than BAND places apart
 * do not meet: entry (i, j) is zero for |i - j| > reach. It is number first + j stride + i: a band, with room for the
 * fill-in of row exchanges, or the full matrix if that is smaller. */
typedef struct {
  int rows, reach, stride, first;
} band;

static band band_of(int blocks)
{
  const int rows = M * blocks, reach = (BAND + 1) * blocks - 1, full = 3 * reach + 1 >= rows;
  const band shape = {rows, reach, full ? rows : 3 * reach, full ? 0 : 2 * reach};
  return shape;
}

/* How many numbers the matrix has. */
static size_t band_size(const band *shape)
{
  return (size_t)shape->rows * (size_t)(shape->first ? shape->stride + 1 : shape->stride);
}

static int least(int a, int b)
{
  return a < b ? a : b;
}

static int most(int a, int b)
{
  return a > b ? a : b;
}

static void exchange(double *a, double *b)
{
  const double kept = *a;
  *a = *b;
  *b = kept;
}

/* x_i -= factor column_i for begin <= i < end. */
static inline void subtract(const double *restrict column, double factor, int begin, int end, double *restrict x)
{
  for (int i = begin; i < end; i++)
    x[i] -= factor * column[i];
}

/* Does to x what was done to the rows of the matrix at columns begin <= k < end: exchanges, subtraction of multiples. */
static void eliminate(const double *a, const band *shape, const double *pivot, int begin, int end, double *x)
{
  for (int k = begin; k < end; k++) {
    if ((int)pivot[k] != k)
      exchange(x + k, x + (int)pivot[k]);
    if (x[k] != 0.0)
      subtract(a + shape->first + k * shape->stride, x[k], k + 1, least(k + shape->reach + 1, shape->rows), x);
  }
}

/* LU factors of the matrix, rows exchanged so that every pivot is the largest of its column. Returns 0 if one vanishes or
 * is not a number; pivot[k] is the row exchanged with k; the diagonal holds the inverses of the pivots. */
static int factorise(double *a, const band *shape, double *pivot)
{
  for (int k = 0; k < shape->rows; k++) {
    double *column = a + shape->first + k * shape->stride;
    const int end = least(k + shape->reach + 1, shape->rows);
    int best = k;
    eliminate(a, shape, pivot, most(k - 2 * shape->reach, 0), k, column);
    for (int i = k + 1; i < end; i++)
      if (fabs(column[i]) > fabs(column[best]))
        best = i;
    pivot[k] = (double)best;
    if (!(fabs(column[best]) > 0.0))
      return 0;
    exchange(column + k, column + best);
    column[k] = 1.0 / column[k];
    for (int i = k + 1; i < end; i++)
      column[i] *= column[k];
  }
  return 1;
}

/* x = a^-1 x with the factors of a. */
static void back_substitute(const double *a, const band *shape, const double *pivot, double *x)
{
  eliminate(a, shape, pivot, 0, shape->rows, x);
  for (int k = shape->rows - 1; k >= 0; k--) {
    const double *column = a + shape->first + k * shape->stride;
    x[k] *= column[k];
    subtract(column, x[k], most(k - 2 * shape->reach, 0), k, x);
  }
}

static const int MASS_ENTRY[1][2] = { /* {i, j}: d p_i / d v_j */
  {0, 0}
};

/* Whether no x is an infinity or a NaN. */
static int all_finite(const double *x, int n)
{
  double sum = 0.0;
  for (int i = 0; i < n; i++)
    sum += 0.0 * x[i];
  return sum == 0.0;
}

/* Momenta at u = (q, v), and the mass matrix dp/dv in the first numbers of scratch. */
static void momentum_and_slopes(double t, const double *u, const double *parameters, double *value, double *scratch)
{
  const band shape = band_of(1);
  double *mass = scratch, *slope = scratch + band_size(&shape);
  (void)t;
  legendre(u, parameters, value, slope);
  memset(mass, 0, sizeof(double) * band_size(&shape));
  for (int e = 0; e < 1; e++)
    mass[shape.first + PLACE[MASS_ENTRY[e][1]] * shape.stride + PLACE[MASS_ENTRY[e][0]]] = slope[e];
}

/* max |value - p|. */
static double largest_misfit(const double *value, const double *p)
{
  double largest = 0.0;
  for (int i = 0; i < M; i++)
    largest = larger(largest, fabs(value[i] - p[i]));
  return largest;
}

int pendulum_verlet_momentum(double t, const double *q, const double *v, const double *parameters, double *p,
    double *workspace)
{
  double u[2 * M], value[M];
  memcpy(u, q, sizeof(double) * M);
  memcpy(u + M, v, sizeof(double) * M);
  momentum_and_slopes(t, u, parameters, value, workspace);
  if (!all_finite(value, M))
    return PENDULUM_VERLET_NOT_FINITE;
  memcpy(p, value, sizeof(double) * M);
  return PENDULUM_VERLET_OK;
}

/* Newton's iteration for L_v(q, v) = p from the velocity in u, halving updates that leave the domain or do not bring p
 * nearer. */
static int invert_momentum(double t, double *u, const double *p, const double *parameters, double *mass)
{
  const band shape = band_of(1);
  double value[M], update[M], pivot[M], misfit;
  momentum_and_slopes(t, u, parameters, value, mass);
  misfit = largest_misfit(value, p);
  for (int k = 0; k < 50; k++) {
    double scale = 1.0, nearer, start[M], roundoff = 0.0;
    if (!all_finite(value, M) || !all_finite(mass, (int)band_size(&shape)))
      return PENDULUM_VERLET_NOT_FINITE;
    if (misfit == 0.0)
      return PENDULUM_VERLET_OK;
    if (!factorise(mass, &shape, pivot))
      return PENDULUM_VERLET_SINGULAR;
    for (int i = 0; i < M; i++) {
      update[PLACE[i]] = p[i] - value[i];
      roundoff = larger(roundoff, 64.0 * DBL_EPSILON * fabs(p[i]));
    }
    back_substitute(mass, &shape, pivot, update);
    memcpy(start, u + M, sizeof(double) * M);
    do {
      for (int i = 0; i < M; i++)
        u[M + i] = start[i] + scale * update[PLACE[i]];
      momentum_and_slopes(t, u, parameters, value, mass);
      nearer = all_finite(value, M) ? largest_misfit(value, p) : INFINITY;
      scale *= 0.5;
    } while (!(nearer < misfit) && misfit > roundoff && scale > DBL_EPSILON);
    if (!(nearer < misfit)) { /* round-off: keep the better velocity */
      memcpy(u + M, start, sizeof(double) * M);
      return misfit <= roundoff ? PENDULUM_VERLET_OK : PENDULUM_VERLET_NOT_CONVERGED;
    }
    misfit = nearer;
  }
  return PENDULUM_VERLET_NOT_CONVERGED;
}

int pendulum_verlet_velocity(double t, const double *q, const double *p, const double *parameters, double *v,
    double *workspace)
{
  int status = PENDULUM_VERLET_SINGULAR;
  for (int attempt = 0; attempt < 3; attempt++) { /* from rest, from v = p, from v = 1 */
    double u[2 * M];
    for (int i = 0; i < M; i++) {
      u[i] = q[i];
      u[M + i] = attempt == 0 ? 0.0 : attempt == 1 ? p[i] : 1.0;
    }
    status = invert_momentum(t, u, p, parameters, workspace);
    if (status == PENDULUM_VERLET_OK) {
      memcpy(v, u + M, sizeof(double) * M);
      return status;
    }
  }
  return status;
}

int pendulum_verlet_energy(double t, const double *q, const double *p, const double *parameters, double *energy,
    double *workspace)
{
  double u[2 * M], value[1], sum;
  const int status = pendulum_verlet_velocity(t, q, p, parameters, u + M, workspace);
  if (status != PENDULUM_VERLET_OK)
    return status;
  memcpy(u, q, sizeof(double) * M);
  lagrangian(u, parameters, value);
  sum = -value[0];
  for (int i = 0; i < M; i++)
    sum += p[i] * u[M + i];
  if (!all_finite(&sum, 1))
    return PENDULUM_VERLET_NOT_FINITE;
  *energy = sum;
  return PENDULUM_VERLET_OK;
}

int pendulum_verlet_energies(long long count, const double *t, const double *q, const double *p, const double *parameters,
    double *energy, double *workspace)
{
  for (long long k = 0; k < count; k++) {
    const int status = pendulum_verlet_energy(t[k], q + k * M, p + k * M, parameters, energy + k, workspace);
    if (status != PENDULUM_VERLET_OK)
      return status;
  }
  return PENDULUM_VERLET_OK;
}

/* scale sum_b table[b][n] z_b for every coordinate i and point n, into u[n * across + i * along]. */
static inline void gather(const double *table, int points, double scale, const double *z, double *u, int across, int along)
{
  for (int i = 0; i < M; i++) {
    double sum[POINTS] = {0.0};
    for (int b = 0; b < B; b++)
      for (int n = 0; n < points; n++)
        sum[n] += table[b * points + n] * z[i * B + b];
    for (int n = 0; n < points; n++)
      u[n * across + i * along] = scale * sum[n];
  }
}

/* u = q0 + u at every point, with what rounding cut off q0 before. */
static inline void offset(const step_data *step, int points, double *u, int across)
{
  for (int n = 0; n < points; n++)
    for (int i = 0; i < M; i++)
      u[n * across + i] = step->q0[i] + (step->carry_q[i] + u[n * across + i]);
}

/* rows_r += sum_n weight[n] scale table[n][r] value_n for every coordinate; the last row is p1, whose terms are also summed
 * without sign into size. */
static inline void scatter(const double *table, int points, const double *weight, double scale, const double *value,
    int across, double *rows, double *size)
{
  for (int i = 0; i < M; i++) {
    double sum[B + 1], end = size[i];
    memcpy(sum, rows + i * (B + 1), sizeof sum);
    for (int n = 0; n < points; n++) {
      const double term = weight[n] * scale * value[n * across + i];
      for (int r = 0; r <= B; r++)
        sum[r] += table[n * (B + 1) + r] * term;
      end += fabs(table[n * (B + 1) + B] * term);
    }
    memcpy(rows + i * (B + 1), sum, sizeof sum);
    size[i] = end;
  }
}

/* Adds sum_n weight[n] scale row[n][r] slope_n column[b][n] to the entries of the Jacobian in rows (i, r), columns (j, b),
 * for every slope and its pair of coordinates i, j. */
static inline void scatter_slopes(const double *row, const double *column, int points, const double *weight, double scale,
    const int (*pair)[2], int count, const double *slope, int across, double *jacobian, const band *shape)
{
  const int blocks = shape->rows / M;
  for (int e = 0; e < count; e++) {
    double *corner = jacobian + shape->first + PLACE[pair[e][1]] * blocks * shape->stride + PLACE[pair[e][0]] * blocks;
    for (int b = 0; b < B; b++) {
      double sum[B] = {0.0};
      for (int n = 0; n < points; n++) {
        const double term = weight[n] * scale * slope[n * across + e] * column[b * points + n];
        if (term != 0.0)
          for (int r = 0; r < B; r++)
            sum[r] += row[n * (B + 1) + r] * term;
      }
      for (int r = 0; r < B; r++)
        corner[b * shape->stride + r] += sum[r];
    }
  }
}

/* Quadrature points: their part of the rows, and of the Jacobian unless it is NULL. */
static void add_quadrature(const step_data *step, const double *z, double *rows, double *size, double *jacobian,
    const band *shape)
{
  const double h = step->h;
  double *u = step->scratch, *value = u + 4, *slope = value + 4;
  gather(QUADRATURE_GATHER_0[0], 2, h, z, u + 0, 2, 1);
  offset(step, 2, u + 0, 2);
  gather(QUADRATURE_GATHER_1[0], 2, 1.0, z, u + 1, 2, 1);
  for (int n = 0; n < 2; n++) {
    if (jacobian)
      quadrature_slope(u + n * 2, step->parameters, value + n * 2, slope + n * 2);
    else
      quadrature_value(u + n * 2, step->parameters, value + n * 2);
  }
  scatter(QUADRATURE_SCATTER_0[0], 2, QUADRATURE_WEIGHT, h, value + 0, 2, rows, size);
  scatter(QUADRATURE_SCATTER_1[0], 2, QUADRATURE_WEIGHT, 1.0, value + 1, 2, rows, size);
  if (!jacobian)
    return;
  scatter_slopes(QUADRATURE_SCATTER_0[0], QUADRATURE_GATHER_0[0], 2, QUADRATURE_WEIGHT, h*h,
      QUADRATURE_SLOPE_0, 1, slope + 0, 2, jacobian, shape);
  scatter_slopes(QUADRATURE_SCATTER_1[0], QUADRATURE_GATHER_1[0], 2, QUADRATURE_WEIGHT, 1.0,
      QUADRATURE_SLOPE_1, 1, slope + 1, 2, jacobian, shape);
}

/* The stage equations: for every coordinate B residuals and p1 - p0 in rows; the sizes of p1 and q1 before cancellation; and
 * the Jacobian, of the shape given, unless it is NULL. */
static void evaluate(const step_data *step, const double *z, double *rows, double *size_p, double *size_q,
    double *jacobian, const band *shape)
{
  for (int i = 0; i < M; i++) {
    for (int r = 0; r < B; r++)
      rows[i * (B + 1) + r] = MOMENTUM_ROW[r] * step->p0[i];
    rows[i * (B + 1) + B] = 0.0;
    size_p[i] = fabs(step->p0[i]);
    size_q[i] = fabs(step->q0[i]);
    for (int b = 0; b < B; b++)
      size_q[i] += fabs(step->h * END_POSITION[b] * z[i * B + b]);
  }
  if (jacobian)
    memset(jacobian, 0, sizeof(double) * band_size(shape));
  add_quadrature(step, z, rows, size_p, jacobian, shape);
}

/* How far the last update moved the stages and the end momentum: the largest ratio to its own size, the ratio of the
 * largest to the largest size, and the largest itself. */
typedef struct {
  double relative, overall, absolute;
} movement;

static movement no_movement(void)
{
  const movement none = {0.0, 0.0, 0.0};
  return none;
}

static void measure(movement *moved, const double *change, const double *size)
{
  double largest_change = 0.0, largest_size = 0.0;
  for (int i = 0; i < M; i++) {
    const double ratio = change[i] != 0.0 ? fabs(change[i]) / size[i] : 0.0;
    moved->relative = larger(moved->relative, ratio);
    largest_change = larger(largest_change, fabs(change[i]));
    largest_size = larger(largest_size, size[i]);
  }
  if (largest_change > moved->overall * largest_size)
    moved->overall = largest_change / largest_size;
  moved->absolute = larger(moved->absolute, largest_change);
}

/* What Newton's iteration works with: unknowns; rows and their update; pivots and factors of the Jacobian. */
typedef struct {
  double *z, *rows, *update, *pivot, *factors;
} newton_data;

static newton_data newton_in(double *workspace)
{
  newton_data data;
  data.z = workspace;
  data.rows = data.z + N;
  data.update = data.rows + N + M;
  data.pivot = data.update + N + M;
  data.factors = data.pivot + N + M;
  return data;
}

/* z -= update, the solution with the factors at hand; p0 likewise, if it is not NULL. Measures the update. */
static void apply_update(const newton_data *data, const band *shape, double h,
double *p0, const double *size_p, const double *size_q, movement *moved)
{
  const int blocks = shape->rows / M;
  double change[M];
  for (int i = 0; i < M; i++)
    memcpy(data->update + PLACE[i] * blocks, data->rows + i * (B + 1), sizeof(double) * (size_t)blocks);
  back_substitute(data->factors, shape, data->pivot, data->update);
  for (int i = 0; i < M; i++) {
    const double *update = data->update + PLACE[i] * blocks;
    change[i] = 0.0;
    for (int b = 0; b < B; b++) {
      data->z[i * B + b] -= update[b];
      change[i] = larger(change[i], fabs(h * update[b]));
    }
  }
  measure(moved, change, size_q);
  for (int i = 0; p0 && i < M; i++) {
    change[i] = data->update[PLACE[i] * blocks + B];
    p0[i] -= change[i];
  }
  if (p0)
    measure(moved, change, size_p);
}

/* Whether the iterate that `moved` led to is accepted: its update is below the tolerance, or at round-off level and no
 * longer shrinking. Kept factors shrink updates only so fast: they must have done so once, and twice to tell round-off
 * from slow progress. */
static int has_converged(const pendulum_verlet_options *options, const movement *moved, double last, int trials)
{
  if (trials < 2)
    return 0;
  if (options->absolute)
    return moved->absolute < options->tolerance;
  return moved->relative <= options->tolerance
      || (trials > 2 && moved->overall <= 1e-11 && moved->relative >= 0.25 * last);
}

/* In place of p1 - p0 the row q0 + h sum_b beta_b z_b = q1, with p0 as further unknown. */
static void add_boundary(const step_data *step, const newton_data *data, const double *q1, int with_jacobian,
    const band *shape)
{
  for (int i = 0; i < M; i++) {
    double *row = data->rows + i * (B + 1) + B;
    *row = -(q1[i] - step->q0[i]) / step->h;
    for (int b = 0; b < B; b++)
      *row += END_POSITION[b] * data->z[i * B + b];
  }
  for (int i = 0; with_jacobian && i < M; i++) {
    double *corner = data->factors + shape->first + PLACE[i] * (B + 1) * (shape->stride + 1);
    for (int b = 0; b < B; b++) {
      corner[B * shape->stride + b] = MOMENTUM_ROW[b];
      corner[b * shape->stride + B] = END_POSITION[b];
    }
  }
}

/* Newton's iteration on the stage equations from the guess in z; on success z and p1 - p0 belong together. The factors, of
 * an earlier step if *keep, serve as long as updates are small and shrink at least 10-fold. With an end position q1, p0
 * is unknown too and found in place. */
static int newton(const step_data *step, const newton_data *data, const double *q1, double *p0, double *increment,
    int *keep, const pendulum_verlet_options *options, pendulum_verlet_report *report)
{
  const band shape = band_of(q1 ? B + 1 : B);
  double size_q[M], size_p[M], change[M], last = INFINITY;
  movement moved = no_movement();
  int trials = 0;
  memset(increment, 0, sizeof(double) * M);
  for (int k = 0;; k++) {
    evaluate(step, data->z, data->rows, size_p, size_q, *keep ? NULL : data->factors, &shape);
    for (int i = 0; i < M; i++) {
      change[i] = data->rows[i * (B + 1) + B] - increment[i];
      increment[i] = data->rows[i * (B + 1) + B];
    }
    if (q1)
      add_boundary(step, data, q1, !*keep, &shape);
    if (!all_finite(data->rows, N + M) || !all_finite(increment, M) || !all_finite(size_p, M) || !all_finite(size_q, M))
      return PENDULUM_VERLET_NOT_FINITE;
    if (k > 0) {
      measure(&moved, change, size_p);
      report->change = options->absolute ? moved.absolute : moved.relative;
      if (has_converged(options, &moved, last, trials))
        return PENDULUM_VERLET_OK;
      last = moved.relative;
    }
    if (k >= options->max_iterations)
      return PENDULUM_VERLET_NOT_CONVERGED;
    trials = *keep ? trials + 1 : 3;
    if (!*keep && !factorise(data->factors, &shape, data->pivot))
      return PENDULUM_VERLET_SINGULAR;
    moved = no_movement();
    apply_update(data, &shape, step->h, p0, size_p, size_q, &moved);
    *keep = has_converged(options, &moved, last, trials)
        || (moved.overall < 0.01 && moved.relative < 0.1 * last);
    report->iterations++;
  }
}

pendulum_verlet_options pendulum_verlet_default_options(void)
{
  const pendulum_verlet_options options = {2.220446049250313e-16, 50, 0};
  return options;
}

/* Kicks of h KICK[n] L_q and drifts of h DRIFT[n] M^-1 p between them. */
static const double KICK[2] = {
  0.5, 0.5
};
static const double DRIFT[1] = {
  1.0
};

/* L_q. Operations: 3 *, 1 neg, 1 sin. */
static void force(const double *u, const double *parameters, double *value)
{
  value[0] = -(parameters[2]*parameters[1]*parameters[0]*sin(u[0]));
}

/* The constant masses, of the parameters alone. */
static void mass(const double *parameters, double *value)
{
  value[0] = parameters[0]*(parameters[1]*parameters[1]);
}

typedef struct {
  double inverse_mass[M];
} solver_data;

static void prepare(const step_data *step, solver_data *data)
{
  mass(step->parameters, data->inverse_mass);
  for (int i = 0; i < M; i++)
    data->inverse_mass[i] = 1.0 / data->inverse_mass[i];
}

/* The increments of one step; memory keeps the last force, which is the first of the next step. */
static int solve(const step_data *step, const solver_data *data, double *memory, long long *guess, double *dq, double *dp,
    const pendulum_verlet_options *options, pendulum_verlet_report *report, double *workspace)
{
  double F[M], u[M];
  (void)options;
  (void)workspace;
  memset(dq, 0, sizeof(double) * M);
  memset(dp, 0, sizeof(double) * M);
  for (int n = 0;; n++) {
    for (int i = 0; i < M; i++)
      u[i] = step->q0[i] + (step->carry_q[i] + dq[i]);
    if (n == 0 && *guess)
      memcpy(F, memory, sizeof F);
    else
      force(u, step->parameters, F);
    for (int i = 0; i < M; i++)
      dp[i] += step->h * KICK[n] * F[i];
    if (n == 1)
      break;
    for (int i = 0; i < M; i++)
      dq[i] += step->h * DRIFT[n] * data->inverse_mass[i] * (step->p0[i] + (step->carry_p[i] + dp[i]));
  }
  report->iterations++;
  if (!all_finite(dq, M) || !all_finite(dp, M))
    return PENDULUM_VERLET_NOT_FINITE;
  memcpy(memory, F, sizeof F);
  *guess = 1;
  return PENDULUM_VERLET_OK;
}

/* Whether x + increment is a finite state. */
static int reaches(const double *x, const double *increment)
{
  double sum = 0.0;
  for (int i = 0; i < M; i++)
    sum += 0.0 * (x[i] + increment[i]);
  return sum == 0.0;
}

int pendulum_verlet_step(double t, double h, const double *q0, const double *p0, const double *parameters,
    const pendulum_verlet_options *options, double *q1, double *p1, pendulum_verlet_report *report, double *workspace)
{
  const pendulum_verlet_options standard = pendulum_verlet_default_options();
  const double nothing[M] = {0.0};
  const step_data step = {t, h, q0, p0, nothing, nothing, parameters, workspace, 1};
  pendulum_verlet_report unread;
  solver_data data;
  double *memory = workspace + SCRATCH, dq[2 * M] = {0.0}, dp[2 * M] = {0.0}; /* increments, then their low parts */
  long long guess = 0;
  int status;
  report = report ? report : &unread;
  memset(report, 0, sizeof *report);
  report->t = t;
  prepare(&step, &data);
  status = solve(&step, &data, memory, &guess, dq, dp, options ? options : &standard, report, memory + MEMORY);
  if (status != PENDULUM_VERLET_OK)
    return status;
  if (!reaches(q0, dq) || !reaches(p0, dp))
    return PENDULUM_VERLET_NOT_FINITE;
  report->steps = 1;
  for (int i = 0; i < M; i++) {
    q1[i] = q0[i] + (dq[i] + dq[M + i]);
    p1[i] = p0[i] + (dp[i] + dp[M + i]);
  }
  return PENDULUM_VERLET_OK;
}

void pendulum_verlet_start(pendulum_verlet_run *run, double t, double h, const double *q, const double *p)
{
  memset(run, 0, sizeof *run);
  run->t0 = t;
  run->h = h;
  memcpy(run->q, q, sizeof(double) * M);
  memcpy(run->p, p, sizeof(double) * M);
}

/* What a step changes, at hand while a call lasts. */
typedef struct {
  double q[M], p[M], carry_q[M], carry_p[M];
} state;

static void load_state(const pendulum_verlet_run *run, state *now)
{
  memcpy(now->q, run->q, sizeof now->q);
  memcpy(now->p, run->p, sizeof now->p);
  memcpy(now->carry_q, run->carry_q, sizeof now->carry_q);
  memcpy(now->carry_p, run->carry_p, sizeof now->carry_p);
}

static void save_state(const state *now, pendulum_verlet_run *run)
{
  memcpy(run->q, now->q, sizeof now->q);
  memcpy(run->p, now->p, sizeof now->p);
  memcpy(run->carry_q, now->carry_q, sizeof now->carry_q);
  memcpy(run->carry_p, now->carry_p, sizeof now->carry_p);
}

/* x + carry += increment with its low part, in twice the precision (Knuth's error of an addition, then Dekker's). */
static void add_compensated(double *x, double *carry, const double *increment)
{
  for (int i = 0; i < M; i++) {
    const double sum = x[i] + increment[i], part = sum - x[i];
    const double rest = ((x[i] - (sum - part)) + (increment[i] - part)) + (carry[i] + increment[M + i]);
    x[i] = sum + rest;
    carry[i] = rest - (x[i] - sum);
  }
}

int pendulum_verlet_advance(pendulum_verlet_run *run, long long steps, long long every, const double *parameters,
    const pendulum_verlet_options *options, double *t, double *q, double *p, int *iterations,
    pendulum_verlet_report *report, double *workspace)
{
  const pendulum_verlet_options standard = pendulum_verlet_default_options();
  state now;
  step_data step = {run->t0, run->h, now.q, now.p, now.carry_q, now.carry_p, parameters, workspace, 1};
  pendulum_verlet_report unread;
  solver_data data;
  long long stored = 0;
  double dq[2 * M] = {0.0}, dp[2 * M] = {0.0}; /* increments, then their low parts */
  report = report ? report : &unread;
  memset(report, 0, sizeof *report);
  load_state(run, &now);
  prepare(&step, &data);
  for (long long k = 0; k < steps; k++) {
    const long long before = report->iterations;
    int status;
    step.first = k == 0;
    report->t = step.t = run->t0 + (double)run->step * run->h;
    status = solve(&step, &data, run->memory, &run->guess, dq, dp, options ? options : &standard, report,
        workspace + SCRATCH);
    if (status == PENDULUM_VERLET_OK && (!reaches(now.q, dq) || !reaches(now.p, dp)))
      status = PENDULUM_VERLET_NOT_FINITE;
    if (status != PENDULUM_VERLET_OK) {
      save_state(&now, run);
      return status;
    }
    add_compensated(now.q, now.carry_q, dq);
    add_compensated(now.p, now.carry_p, dp);
    run->iterations += report->iterations - before;
    run->step++;
    report->steps++;
    if (run->step % every == 0) {
      t[stored] = run->t0 + (double)run->step * run->h;
      memcpy(q + stored * M, now.q, sizeof(double) * M);
      memcpy(p + stored * M, now.p, sizeof(double) * M);
      iterations[stored] = (int)run->iterations;
      run->iterations = 0;
      stored++;
    }
  }
  save_state(&now, run);
  return PENDULUM_VERLET_OK;
}

/* h^1 sum_n w_n lagrangian along the curve given by z. */
static double quadrature_sum(const step_data *step, const double *z)
{
  const double h = step->h;
  double *u = step->scratch, sum = 0.0;
  gather(QUADRATURE_GATHER_0[0], 2, h, z, u + 0, 2, 1);
  offset(step, 2, u + 0, 2);
  gather(QUADRATURE_GATHER_1[0], 2, 1.0, z, u + 1, 2, 1);
  for (int n = 0; n < 2; n++) {
    double value[1];
    lagrangian(u + n * 2, step->parameters, value);
    sum += QUADRATURE_WEIGHT[n] * value[0];
  }
  return h * sum;
}

int pendulum_verlet_discrete_legendre(double t, double h, const double *q0, const double *q1, const double *parameters,
    const pendulum_verlet_options *options, double *p0, double *p1, double *action, pendulum_verlet_report *report,
    double *workspace)
{
  const pendulum_verlet_options standard = pendulum_verlet_default_options();
  const double carry_q[M] = {0.0};
  pendulum_verlet_report unread;
  const newton_data data = newton_in(workspace + SCRATCH);
  double v[M], start_p[M], increment[M];
  const step_data step = {t, h, q0, start_p, carry_q, carry_q, parameters, workspace, 1};
  int keep = 0, status;
  report = report ? report : &unread;
  memset(report, 0, sizeof *report);
  for (int i = 0; i < M; i++)
    v[i] = (q1[i] - q0[i]) / h;
  status = pendulum_verlet_momentum(t, q0, v, parameters, start_p, workspace);
  for (int i = 0; i < M; i++)
    for (int b = 0; b < B; b++)
      data.z[i * B + b] = STRAIGHT[b] * v[i];
  if (status == PENDULUM_VERLET_OK)
    status = newton(&step, &data, q1, start_p, increment, &keep, options ? options : &standard, report);
  if (status != PENDULUM_VERLET_OK)
    return status;
  for (int i = 0; i < M; i++) {
    p0[i] = start_p[i];
    p1[i] = start_p[i] + increment[i];
  }
  *action = quadrature_sum(&step, data.z);
  return PENDULUM_VERLET_OK;
}
