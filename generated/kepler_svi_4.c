/* Kepler problem: Galerkin spectral variational integrator, degree 4, gauss-legendre:4; see kepler_svi_4.h. */
#include "kepler_svi_4.h"

#include <float.h>
#include <math.h>
#include <string.h>

enum {
  M = 2, /* coordinates */
  B = 4, /* blocks of M unknowns */
  N = B * M,
  POINTS = 4, /* most points of a family, or blocks */
  BAND = 1, /* coordinates that meet are at most so many places apart */
  MEMORY = 16, /* numbers kept from step to step */
  SCRATCH = 56 /* arguments, values and slopes at all points, or the mass matrix with its slopes */
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

static inline double smaller(double a, double b)
{
  return a < b ? a : b;
}

/* q1 = q0 + h sum_b END_POSITION[b] z_b; row r holds MOMENTUM_ROW[r] p0; the straight-line guess of z_b is STRAIGHT[b]
 * v0. */
static const double END_POSITION[4] = {
  0.17392742256872684, 0.32607257743127316, 0.32607257743127316, 0.17392742256872684
};

static const double MOMENTUM_ROW[4] = {
  0.17392742256872684, 0.32607257743127316, 0.32607257743127316, 0.17392742256872684
};

static const double STRAIGHT[4] = {
  1.0, 1.0, 1.0, 1.0
};


/* Quadrature: 4 points.
 * Gather tables have one row a block and one column a point, scatter tables one row a point and one column a row of
 * equations, a last one for p1. */
static const double QUADRATURE_WEIGHT[4] = {
  0.17392742256872684, 0.32607257743127316, 0.32607257743127316, 0.17392742256872684
};

static const double QUADRATURE_GATHER_0[4][4] = {
  {0.08696371128436353, 0.18811811749986806, 0.16719192197418886, 0.17748257225452257},
  {-0.026604180084998763, 0.16303628871563647, 0.3539530060337439, 0.3134451147418684},
  {0.012627462689404734, -0.027880428602470975, 0.16303628871563647, 0.3526767575162719},
  {-0.003555149685795733, 0.006735500594538202, -0.014190694931141223, 0.08696371128436353}
};

static const double QUADRATURE_GATHER_1[4][4] = {
  {1.0, 0.0, 0.0, 0.0},
  {0.0, 1.0, 0.0, 0.0},
  {0.0, 0.0, 1.0, 0.0},
  {0.0, 0.0, 0.0, 1.0}
};

static const double QUADRATURE_SCATTER_0[4][5] = {
  {0.08696371128436331, 0.3526767575162719, 0.3134451147418684, 0.17748257225452257, 1.0},
  {-0.014190694931141223, 0.1630362887156367, 0.35395300603374413, 0.16719192197418864, 1.0},
  {0.00673550059453798, -0.027880428602470753, 0.1630362887156367, 0.18811811749986806, 1.0},
  {-0.003555149685795733, 0.012627462689404734, -0.026604180084998763, 0.08696371128436331, 1.0}
};

static const double QUADRATURE_SCATTER_1[4][5] = {
  {-1.0, 0.0, 0.0, 0.0, 0.0},
  {0.0, -1.0, 0.0, 0.0, 0.0},
  {0.0, 0.0, -1.0, 0.0, 0.0},
  {0.0, 0.0, 0.0, -1.0, 0.0}
};

static const int QUADRATURE_SLOPE_0[4][2] = { /* {i, j}: d value_i / d u_j */
  {0, 0}, {0, 1}, {1, 0}, {1, 1}
};

static const int QUADRATURE_SLOPE_1[2][2] = { /* {i, j}: d value_i / d u_j */
  {0, 0}, {1, 1}
};

/* x^(-1/2) */
static inline double inverse_root_1(double x)
{
  const double inverse = 1.0/x;
  return inverse*sqrt(x);
}

/* x^(-3/2) */
static inline double inverse_root_3(double x)
{
  const double inverse = 1.0/x;
  return inverse*inverse*sqrt(x);
}

/* x^(-5/2) */
static inline double inverse_root_5(double x)
{
  const double inverse = 1.0/x;
  return inverse*inverse*inverse*sqrt(x);
}

/* L_q and L_v at u = (q, v). Operations: 5 *, 1 +, 1 inverse_root_3, 2 neg. */
static void quadrature_value(const double *u, const double *parameters, double *value)
{
  value[2] = u[2];
  value[3] = u[3];
  const double w0 = parameters[0]*inverse_root_3(u[0]*u[0] + u[1]*u[1]);
  value[0] = -(w0*u[0]);
  value[1] = -(w0*u[1]);
}

/* The same, and the non-zero derivatives with respect to u = (q, v). Operations: 13 *, 1 +, 2 -, 1 inverse_root_3, 1 inverse_root_5, 4 neg. */
static void quadrature_slope(const double *u, const double *parameters, double *value, double *slope)
{
  value[2] = u[2];
  value[3] = u[3];
  slope[4] = 1.0;
  slope[5] = 1.0;
  const double w0 = u[0]*u[0];
  const double w1 = u[1]*u[1];
  const double w2 = w0 + w1;
  const double w3 = parameters[0]*inverse_root_3(w2);
  value[0] = -(w3*u[0]);
  value[1] = -(w3*u[1]);
  const double w4 = 3.0*parameters[0];
  const double w5 = inverse_root_5(w2);
  slope[0] = -(w3 - w4*w0*w5);
  slope[3] = -(w3 - w4*w1*w5);
  const double w6 = w4*w5*u[0]*u[1];
  slope[1] = w6;
  slope[2] = w6;
}

/* Momenta L_v and mass matrix L_vv at u = (q, v). Operations: constants. */
static void legendre(const double *u, double *value, double *slope)
{
  value[0] = u[2];
  value[1] = u[3];
  slope[0] = 1.0;
  slope[1] = 1.0;
}

/* L at u = (q, v). Operations: 7 *, 3 +, 1 inverse_root_1. */
static void lagrangian(const double *u, const double *parameters, double *value)
{
  value[0] = 0.5*(u[2]*u[2] + u[3]*u[3] + 2.0*parameters[0]*inverse_root_1(u[0]*u[0] + u[1]*u[1]));
}

/* What is conserved at u = (q, p), then the sums of the squares of the terms. Operations: 8 *, 1 +, 1 -. */
static void momentum_maps(const double *u, double *value)
{
  value[0] = u[3]*u[0] - u[2]*u[1];
  value[1] = u[2]*u[2]*(u[1]*u[1]) + u[3]*u[3]*(u[0]*u[0]);
}

/* Place of each coordinate in the order in which those that meet stand near each other. */
static const int PLACE[M] = {
  0, 1
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

static const int MASS_ENTRY[2][2] = { /* {i, j}: d p_i / d v_j */
  {0, 0}, {1, 1}
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
  (void)parameters;
  legendre(u, value, slope);
  memset(mass, 0, sizeof(double) * band_size(&shape));
  for (int e = 0; e < 2; e++)
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

int kepler_svi_4_momentum(double t, const double *q, const double *v, const double *parameters, double *p,
    double *workspace)
{
  double u[2 * M], value[M];
  memcpy(u, q, sizeof(double) * M);
  memcpy(u + M, v, sizeof(double) * M);
  momentum_and_slopes(t, u, parameters, value, workspace);
  if (!all_finite(value, M))
    return KEPLER_SVI_4_NOT_FINITE;
  memcpy(p, value, sizeof(double) * M);
  return KEPLER_SVI_4_OK;
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
      return KEPLER_SVI_4_NOT_FINITE;
    if (misfit == 0.0)
      return KEPLER_SVI_4_OK;
    if (!factorise(mass, &shape, pivot))
      return KEPLER_SVI_4_SINGULAR;
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
      return misfit <= roundoff ? KEPLER_SVI_4_OK : KEPLER_SVI_4_NOT_CONVERGED;
    }
    misfit = nearer;
  }
  return KEPLER_SVI_4_NOT_CONVERGED;
}

int kepler_svi_4_velocity(double t, const double *q, const double *p, const double *parameters, double *v,
    double *workspace)
{
  int status = KEPLER_SVI_4_SINGULAR;
  for (int attempt = 0; attempt < 3; attempt++) { /* from rest, from v = p, from v = 1 */
    double u[2 * M];
    for (int i = 0; i < M; i++) {
      u[i] = q[i];
      u[M + i] = attempt == 0 ? 0.0 : attempt == 1 ? p[i] : 1.0;
    }
    status = invert_momentum(t, u, p, parameters, workspace);
    if (status == KEPLER_SVI_4_OK) {
      memcpy(v, u + M, sizeof(double) * M);
      return status;
    }
  }
  return status;
}

int kepler_svi_4_energy(double t, const double *q, const double *p, const double *parameters, double *energy,
    double *workspace)
{
  double u[2 * M], value[1], sum;
  const int status = kepler_svi_4_velocity(t, q, p, parameters, u + M, workspace);
  if (status != KEPLER_SVI_4_OK)
    return status;
  memcpy(u, q, sizeof(double) * M);
  lagrangian(u, parameters, value);
  sum = -value[0];
  for (int i = 0; i < M; i++)
    sum += p[i] * u[M + i];
  if (!all_finite(&sum, 1))
    return KEPLER_SVI_4_NOT_FINITE;
  *energy = sum;
  return KEPLER_SVI_4_OK;
}

int kepler_svi_4_energies(long long count, const double *t, const double *q, const double *p, const double *parameters,
    double *energy, double *workspace)
{
  for (long long k = 0; k < count; k++) {
    const int status = kepler_svi_4_energy(t[k], q + k * M, p + k * M, parameters, energy + k, workspace);
    if (status != KEPLER_SVI_4_OK)
      return status;
  }
  return KEPLER_SVI_4_OK;
}

int kepler_svi_4_momentum_maps(long long count, const double *t, const double *q, const double *p,
    const double *parameters, double *map, double *size)
{
  enum { MAPS = 1 };
  (void)t;
  (void)parameters;
  for (long long k = 0; k < count; k++) {
    double u[2 * M], value[2 * MAPS];
    memcpy(u, q + k * M, sizeof(double) * M);
    memcpy(u + M, p + k * M, sizeof(double) * M);
    momentum_maps(u, value);
    if (!all_finite(value, MAPS))
      return KEPLER_SVI_4_NOT_FINITE;
    for (int j = 0; j < MAPS; j++) {
      map[k * MAPS + j] = value[j];
      if (size)
        size[k * MAPS + j] = sqrt(value[MAPS + j]);
    }
  }
  return KEPLER_SVI_4_OK;
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
  double *u = step->scratch, *value = u + 16, *slope = value + 16;
  gather(QUADRATURE_GATHER_0[0], 4, h, z, u + 0, 4, 1);
  offset(step, 4, u + 0, 4);
  gather(QUADRATURE_GATHER_1[0], 4, 1.0, z, u + 2, 4, 1);
  for (int n = 0; n < 4; n++) {
    if (jacobian)
      quadrature_slope(u + n * 4, step->parameters, value + n * 4, slope + n * 6);
    else
      quadrature_value(u + n * 4, step->parameters, value + n * 4);
  }
  scatter(QUADRATURE_SCATTER_0[0], 4, QUADRATURE_WEIGHT, h, value + 0, 4, rows, size);
  scatter(QUADRATURE_SCATTER_1[0], 4, QUADRATURE_WEIGHT, 1.0, value + 2, 4, rows, size);
  if (!jacobian)
    return;
  scatter_slopes(QUADRATURE_SCATTER_0[0], QUADRATURE_GATHER_0[0], 4, QUADRATURE_WEIGHT, h*h,
      QUADRATURE_SLOPE_0, 4, slope + 0, 6, jacobian, shape);
  scatter_slopes(QUADRATURE_SCATTER_1[0], QUADRATURE_GATHER_1[0], 4, QUADRATURE_WEIGHT, 1.0,
      QUADRATURE_SLOPE_1, 2, slope + 4, 6, jacobian, shape);
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
static int has_converged(const kepler_svi_4_options *options, const movement *moved, double last, int trials)
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
    int *keep, const kepler_svi_4_options *options, kepler_svi_4_report *report)
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
      return KEPLER_SVI_4_NOT_FINITE;
    if (k > 0) {
      measure(&moved, change, size_p);
      report->change = options->absolute ? moved.absolute : moved.relative;
      if (has_converged(options, &moved, last, trials))
        return KEPLER_SVI_4_OK;
      last = moved.relative;
    }
    if (k >= options->max_iterations)
      return KEPLER_SVI_4_NOT_CONVERGED;
    trials = *keep ? trials + 1 : 3;
    if (!*keep && !factorise(data->factors, &shape, data->pivot))
      return KEPLER_SVI_4_SINGULAR;
    moved = no_movement();
    apply_update(data, &shape, step->h, p0, size_p, size_q, &moved);
    *keep = has_converged(options, &moved, last, trials)
        || (moved.overall < 0.01 && moved.relative < 0.1 * last);
    report->iterations++;
  }
}

#ifdef __GNUC__
/* Vectors of points. GCC and Clang map them to whatever the processor has. */
#pragma GCC diagnostic ignored "-Wpsabi" /* everything that takes a vector is static */

enum { LANES = 4 };
typedef double lanes __attribute__((vector_size(8 * 4)));
typedef union {
  lanes all;
  double lane[LANES];
} lane_view;

static inline lanes lanes_of(double x)
{
  const lanes zero = {0.0};
  return zero + x;
}

#if defined(__AVX512F__) && 4 % 8 == 0
static inline lanes lanes_estimate_inverse_root(lanes x)
{
  typedef double part __attribute__((vector_size(64)));
  const part zero = {0.0};
  union {
    lanes all;
    part parts[LANES / 8];
  } view = {x};
  for (int j = 0; j < LANES / 8; j++)
    view.parts[j] = __builtin_ia32_rsqrt14pd512_mask(view.parts[j], zero, 255);
  return view.all;
}
#endif

#if !defined(__AVX512F__) || 4 % 8 != 0
static inline lanes lanes_sqrt(lanes x)
{
  lane_view view = {x};
  for (int j = 0; j < LANES; j++)
    view.lane[j] = sqrt(view.lane[j]);
  return view.all;
}
#endif

/* x^(-3/2). AVX-512 has the inverse root to 14 bits; with e = 1 - x y^2 the rest is the series of (1 - e)^(-3/2). */
static inline lanes lanes_inverse_root_3(lanes x)
{
#if defined(__AVX512F__) && 4 % 8 == 0
  const lanes y = lanes_estimate_inverse_root(x), square = y * y, e = 1.0 - x * square;
  const lanes power = square * y, first = 1.5 + 1.875 * e, then = 2.1875 + 2.4609375 * e;
  return power + (power * e) * (first + (e * e) * then);
#else
  const lanes inverse = 1.0 / x;
  return inverse * inverse * lanes_sqrt(x);
#endif
}

/* Column j of a table multiplies point j: POINT_x holds what one point gives to all. Lanes beyond point 4 repeat it.
 * The method's numbers are those here and in the _LOW tables together. */
static const lanes POINT_DRIFT = {0.06943184420297377, 0.33000947820757176, 0.669990521792428, 0.9305681557970265};
static const lanes POINT_DRIFT_LOW = {0.0, 0.0, 0.0, 0.0};
static const lanes POINT_PRODUCT[4] = {
  {0.004038191450846724, 0.0435635809023962, 0.1058643526335763, 0.14879849619263774},
  {-0.003295860944944722, 0.01381895140629609, 0.10651836096505307, 0.19847049885237733},
  {0.002644782952066807, -0.0043401341944350295, 0.013818951406296107, 0.08167135979587767},
  {-0.0009767229632558895, 0.0014107297391595273, -0.0017580153590805582, 0.004038191450846724}
};
static const lanes POINT_PRODUCT_LOW[4] = {
  {2.969832286390496e-19, 3.92700054182345e-19, 2.0415291784078956e-18, -2.537765970837727e-18},
  {-1.819477670872445e-19, -9.620710259334002e-20, -4.784156577918922e-18, -9.692155994116688e-18},
  {1.5106023101830726e-19, -9.622051427704511e-20, 5.456755741398015e-19, -2.2149380791266858e-18},
  {-7.155028231069932e-20, -6.907655213282067e-20, 9.409968381595206e-20, 2.969832286390496e-19}
};
static const lanes POINT_END_POSITION = {0.16185132086231022, 0.21846553629538065, 0.10760704113589256, 0.012076101706416587};
static const lanes POINT_END_POSITION_LOW = {-4.851905682326445e-19, 1.1305955096787434e-17, 5.5855503045684676e-18, 2.946120982047505e-20};
static const lanes POINT_END_MOMENTUM = {0.17392742256872684, 0.32607257743127316, 0.32607257743127316, 0.17392742256872684};
static const lanes POINT_END_MOMENTUM_LOW = {0.0, 0.0, 0.0, 0.0};

/* From the forces of the last step and of the one before to the product with the forces of the next. */
static const lanes LAST_ALONE[4] = {
  {0.00039681535159890826, -0.02950413821661833, -0.31588704803200196, -1.094499341752408},
  {-0.0006159736538563859, 0.09740091828951876, 1.005597396377794, 3.3896437163261783},
  {-0.0007480595782675967, -0.164475663000625, -1.5258677609838456, -4.825950141339047},
  {0.0033776083752379937, 0.15103201078114137, 1.0606010622838986, 2.9637843130570163}
};
static const lanes LAST[4] = {
  {0.08319060417123256, -0.3459646936280077, -3.7072096171583175, -17.265518328081257},
  {-0.1424769150297597, 0.7499144190568944, 8.074520972710324, 35.53430983434071},
  {0.06696855362323173, -0.5045293117408256, -5.242038557529745, -21.40152619388321},
  {-0.013677087017423196, 0.2416275660243162, 2.0561002176020393, 7.353446066197164}
};
static const lanes BEFORE[4] = {
  {-0.009794687367041414, 0.0364161505564335, 0.3789777164120157, 1.8163169430229182},
  {0.04555177197165664, -0.17664461024167727, -1.8543116628735528, -8.786915109053952},
  {-0.11924868100977012, 0.5010961200119063, 5.325243917524658, 24.716673635935383},
  {0.09189683115258643, -0.44746251218562305, -4.806839337041577, -21.533808302186017}
};

/* sum_j table[j] x_j of a vector in memory, one after the other. */
static inline lanes lanes_apply_at(const lanes *table, const lanes *vector)
{
  const lane_view *x = (const lane_view *)vector;
  lanes a = table[0] * x->lane[0];
  for (int j = 1; j < LANES; j++)
    a += table[j] * x->lane[j];
  return a;
}

static inline double lanes_total(lanes x)
{
  lane_view view = {x};
  for (int half = LANES / 2; half > 0; half /= 2)
    for (int j = 0; j < half; j++)
      view.lane[j] += view.lane[j + half];
  return view.lane[0];
}

static inline void lanes_load(const double *memory, lanes *x)
{
  memcpy(x, memory, sizeof(double) * M * LANES);
}

static inline void lanes_store(const lanes *x, double *memory)
{
  memcpy(memory, x, sizeof(double) * M * LANES);
}

/* 1 / (size + a little of the largest), so that a coordinate that rests at 0 has a size too; or what makes changes of x
 * changes of q. An infinite size gives NaN. */
static inline void invert_sizes(const kepler_svi_4_options *options, double absolute, double *size)
{
  double largest = 0.0;
  for (int i = 0; i < M; i++)
    largest = larger(largest, size[i]);
  for (int i = 0; i < M; i++)
    size[i] = (options->absolute ? absolute : 1.0 / (size[i] + DBL_EPSILON * largest + DBL_MIN)) + 0.0 * largest;
}

/* What is kept at the points, continued into this step from the last one or from the last two. */
static inline void continue_curve(const double *memory, long long steps, lanes *x)
{
  lanes before[M];
  lanes_load(memory, x);
  lanes_load(memory + M * LANES, before);
  for (int i = 0; i < M; i++)
    x[i] = steps == 1 ? lanes_apply_at(LAST_ALONE, &x[i]) : lanes_apply_at(LAST, &x[i]) + lanes_apply_at(BEFORE, &before[i]);
}

static inline void remember_curve(const lanes *x, double *memory)
{
  memcpy(memory + M * LANES, memory, sizeof(double) * M * LANES);
  lanes_store(x, memory);
}

/* From how many steps the next guess is best continued: a polynomial of high degree through two is the better one while
 * guesses are good, and the worse one when the steps are long. */
static inline long long steps_to_continue(long long steps, double first_change)
{
  return steps > 0 && first_change < 1e-06 ? 2 : 1;
}

/* L_q at all points. Operations: 5 *, 1 +, 1 inverse_root_3, 2 neg. */
static inline void force_lanes(const lanes *u, const double *parameters, lanes *value)
{
  const lanes w0 = parameters[0]*lanes_inverse_root_3(u[0]*u[0] + u[1]*u[1]);
  value[0] = -(w0*u[0]);
  value[1] = -(w0*u[1]);
}

/* The constant masses, of the parameters alone. */
static void mass(double *value)
{
  value[0] = 1.0;
  value[1] = 1.0;
}

/* What the steps of a run share: h^2 = square + square_low, h w = weight + weight_low. */
typedef struct {
  lanes weight, weight_low;
  double inverse_mass[M], square, square_low;
} sweep_data;

static void prepare_sweep(const step_data *step, sweep_data *data)
{
  const double h = step->h;
  const lane_view w = {POINT_END_MOMENTUM}, w_low = {POINT_END_MOMENTUM_LOW};
  lane_view low;
  data->square = h * h;
  data->square_low = fma(h, h, -data->square);
  data->weight = h * w.all;
  for (int j = 0; j < LANES; j++)
    low.lane[j] = fma(h, w.lane[j], -(h * w.lane[j])) + h * w_low.lane[j];
  data->weight_low = low.all;
  mass(data->inverse_mass);
  for (int i = 0; i < M; i++)
    data->inverse_mass[i] = 1.0 / data->inverse_mass[i];
}

/* What follows a sweep would change the points by, squared, with a margin: the rate of contraction is that from the sweep
 * before, whose change is infinite before the first. */
static inline double expected_change(double change, double last, int absolute)
{
  const double quotient = change / last, ratio = last < INFINITY ? smaller(larger(quotient, 1e-6), 0.25) : 1.0; /* squares */
  return absolute ? change : 16.0 * ratio * change * ratio;
}

/* Whether a sweep that changed the points by the square root of `change` (relative to the state) was good enough: what
 * follows it would change them by less than a quarter of the tolerance, or rounding stops the shrinking: 1; 0: go on; -1: it
 * contracts too slowly or not at all. Without branches, for many at once. */
static inline int sweep_status(double change, double last, double tolerance, int absolute, int max_iterations, int k)
{
  const int small = expected_change(change, last, absolute) <= tolerance * tolerance;
  const int stopped = (change == 0.0) | ((k > 0) & (change >= last * 0.0625) & (change < 1e-25));
  const int slow = (k >= max_iterations) | ((k > 4) & (change > 0.5 * last) & (change > 1e-20));
  return change < INFINITY ? (small | stopped ? 1 : -slow) : -1;
}

/* a b + c with one rounding, on which a small c has its say. */
static inline lanes multiply_add(lanes a, lanes b, lanes c)
{
  lane_view x = {a}, y = {b}, z = {c};
  for (int j = 0; j < LANES; j++)
    z.lane[j] = fma(x.lane[j], y.lane[j], z.lane[j]);
  return z.all;
}

/* x + (y + rest) for a rest that is less than the rounding of x + y, which would round it away. */
static inline lanes sum_of_three(lanes x, lanes y, lanes rest)
{
  const lanes sum = x + y, part = sum - x;
  return sum + (((x - (sum - part)) + (y - part)) + rest);
}

/* One step. The points X follow q0 + h c v0 + h^2 (a A) F / m until they rest; then once more, and the increments with
 * their low parts, with all digits of the coefficients. The forces stay in memory. */
static inline __attribute__((always_inline)) int sweep(const step_data *step, const sweep_data *data, double *memory, long long *steps, double *dq, double *dp,
    const kepler_svi_4_options *options, kepler_svi_4_report *report)
{
  lanes X[M], base[M], F[M];
  double drift[M], drift_low[M], inverse_size[M], first = 0.0, last = INFINITY;
  int status = 0;
  for (int i = 0; i < M; i++) {
    const double v = data->inverse_mass[i] * step->p0[i], v_low = fma(data->inverse_mass[i], step->p0[i], -v);
    drift[i] = step->h * v;
    drift_low[i] = fma(step->h, v, -drift[i]) + step->h * (v_low + data->inverse_mass[i] * step->carry_p[i]);
    base[i] = step->q0[i] + POINT_DRIFT * drift[i];
    X[i] = base[i];
  }
  if (*steps > 0) {
    continue_curve(memory, *steps, F);
    for (int i = 0; i < M; i++)
      X[i] += (data->square * data->inverse_mass[i]) * F[i];
  }
  force_lanes(X, step->parameters, F);
  for (int i = 0; i < M; i++) {
    const lane_view force = {F[i]};
    inverse_size[i] = fabs(step->q0[i]) + fabs(drift[i]) + fabs(data->square * data->inverse_mass[i] * force.lane[0]);
  }
  invert_sizes(options, 1.0, inverse_size);
  for (int k = 0; status == 0; k++) {
    lanes change = lanes_of(0.0);
    double total;
    for (int i = 0; i < M; i++) {
      const lanes x = base[i] + (data->square * data->inverse_mass[i]) * lanes_apply_at(POINT_PRODUCT, &F[i]);
      const lanes moved = (x - X[i]) * inverse_size[i];
      change += moved * moved;
      X[i] = x;
    }
    force_lanes(X, step->parameters, F);
    total = lanes_total(change);
    status = sweep_status(total, last, options->tolerance, options->absolute, options->max_iterations, k);
    first = k == 0 ? total : first;
    last = total;
    report->iterations++;
  }
  report->change = sqrt(last);
  if (status < 0)
    return last < INFINITY ? KEPLER_SVI_4_NOT_CONVERGED : KEPLER_SVI_4_NOT_FINITE;
  for (int i = 0; i < M; i++) {
    const lanes sum = lanes_apply_at(POINT_PRODUCT, &F[i]), low = lanes_apply_at(POINT_PRODUCT_LOW, &F[i]);
    const lanes rest = step->carry_q[i] + POINT_DRIFT * drift_low[i] + POINT_DRIFT_LOW * drift[i];
    X[i] = sum_of_three(lanes_of(step->q0[i]), POINT_DRIFT * drift[i] + data->inverse_mass[i] * (data->square * sum),
        rest + data->inverse_mass[i] * (data->square * low + data->square_low * sum));
  }
  force_lanes(X, step->parameters, F);
  for (int i = 0; i < M; i++) {
    const double sum = lanes_total(multiply_add(POINT_END_POSITION, F[i], POINT_END_POSITION_LOW * F[i]));
    const double kick = data->inverse_mass[i] * (data->square * sum), part = (drift[i] + kick) - drift[i];
    dq[i] = drift[i] + kick;
    dq[M + i] = (drift[i] - (dq[i] - part)) + (kick - part)
        + (drift_low[i] + data->inverse_mass[i] * (data->square_low * sum));
    dp[i] = lanes_total(multiply_add(data->weight, F[i], data->weight_low * F[i]));
  }
  if (!all_finite(dq, M) || !all_finite(dp, M))
    return KEPLER_SVI_4_NOT_FINITE;
  remember_curve(F, memory);
  *steps = steps_to_continue(*steps, first);
  return KEPLER_SVI_4_OK;
}
#endif

kepler_svi_4_options kepler_svi_4_default_options(void)
{
  const kepler_svi_4_options options = {2.220446049250313e-16, 50, 0};
  return options;
}

/* Newton's iteration from the guess that q moves on a straight line with its initial velocity. */
static int newton_from_line(const step_data *step, const newton_data *data, double *dp, int *keep,
    const kepler_svi_4_options *options, kepler_svi_4_report *report)
{
  double v[M];
  const int status = kepler_svi_4_velocity(step->t, step->q0, step->p0, step->parameters, v, step->scratch);
  if (status != KEPLER_SVI_4_OK)
    return status;
  for (int i = 0; i < M; i++)
    for (int b = 0; b < B; b++)
      data->z[i * B + b] = STRAIGHT[b] * v[i];
  *keep = 0;
  return newton(step, data, NULL, NULL, dp, keep, options, report);
}
#ifdef __GNUC__
typedef sweep_data solver_data;

static void prepare(const step_data *step, solver_data *data)
{
  prepare_sweep(step, data);
}

/* The increments where the curve continued from former steps leads nowhere: by sweeps from the straight line, else by
 * Newton's iteration. */
static int solve_again(const step_data *step, const solver_data *data, double *memory, long long *guess, double *dq, double *dp,
    const kepler_svi_4_options *options, kepler_svi_4_report *report, double *workspace)
{
  long long steps = 0;
  int status = KEPLER_SVI_4_NOT_CONVERGED;
  if (*guess > 0)
    status = sweep(step, data, memory, &steps, dq, dp, options, report);
  if (status != KEPLER_SVI_4_OK) {
    const newton_data newtons = newton_in(workspace);
    int keep;
    status = newton_from_line(step, &newtons, dp, &keep, options, report);
    gather(END_POSITION, 1, step->h, newtons.z, dq, 0, 1);
    memset(dq + M, 0, sizeof(double) * M);
    memset(dp + M, 0, sizeof(double) * M);
    steps = 0;
  }
  if (status == KEPLER_SVI_4_OK)
    *guess = steps;
  return status;
}

/* The increments by sweeps. On success guess says from how many steps the next is continued. */
static inline __attribute__((always_inline)) int solve(const step_data *step, const solver_data *data, double *memory, long long *guess, double *dq, double *dp,
    const kepler_svi_4_options *options, kepler_svi_4_report *report, double *workspace)
{
  long long steps = *guess;
  const int status = sweep(step, data, memory, &steps, dq, dp, options, report);
  if (status != KEPLER_SVI_4_OK)
    return solve_again(step, data, memory, guess, dq, dp, options, report, workspace);
  *guess = steps;
  return status;
}
#else

/* The guess from the step before is sum_c EXTRAPOLATION[c][b] z_c. */
static const double EXTRAPOLATION[4][4] = {
  {-0.3043475322896335, -1.956342611081263, -7.352359801851611, -14.971892910590412},
  {1.0425440204501055, 6.246427614654768, 22.244205449220566, 44.09613181879383},
  {-1.929896390297009, -9.46401244076669, -29.80681363156252, -55.9889724574008},
  {2.191699902136537, 6.173927437193185, 15.914967984193565, 27.864733549197386}
};

typedef struct {
  int unused;
} solver_data;

static void prepare(const step_data *step, solver_data *data)
{
  (void)step;
  data->unused = 0;
}

/* The increments by Newton's iteration, from the stages of the step before, extrapolated, and from the straight line if
 * there are none or they lead nowhere. Memory holds the stages. */
static int solve(const step_data *step, const solver_data *unused, double *memory, long long *guess, double *dq, double *dp,
    const kepler_svi_4_options *options, kepler_svi_4_report *report, double *workspace)
{
  const newton_data data = newton_in(workspace);
  int status = KEPLER_SVI_4_NOT_CONVERGED, keep = 0;
  (void)unused;
  if (*guess) {
    gather(EXTRAPOLATION[0], B, 1.0, memory, data.z, 1, B);
    status = newton(step, &data, NULL, NULL, dp, &keep, options, report);
  }
  if (status != KEPLER_SVI_4_OK)
    status = newton_from_line(step, &data, dp, &keep, options, report);
  if (status != KEPLER_SVI_4_OK)
    return status;
  gather(END_POSITION, 1, step->h, data.z, dq, 0, 1);
  memcpy(memory, data.z, sizeof(double) * N);
  *guess = 1;
  return status;
}
#endif

/* Whether x + increment is a finite state. */
static int reaches(const double *x, const double *increment)
{
  double sum = 0.0;
  for (int i = 0; i < M; i++)
    sum += 0.0 * (x[i] + increment[i]);
  return sum == 0.0;
}

int kepler_svi_4_step(double t, double h, const double *q0, const double *p0, const double *parameters,
    const kepler_svi_4_options *options, double *q1, double *p1, kepler_svi_4_report *report, double *workspace)
{
  const kepler_svi_4_options standard = kepler_svi_4_default_options();
  const double nothing[M] = {0.0};
  const step_data step = {t, h, q0, p0, nothing, nothing, parameters, workspace, 1};
  kepler_svi_4_report unread;
  solver_data data;
  double *memory = workspace + SCRATCH, dq[2 * M] = {0.0}, dp[2 * M] = {0.0}; /* increments, then their low parts */
  long long guess = 0;
  int status;
  report = report ? report : &unread;
  memset(report, 0, sizeof *report);
  report->t = t;
  prepare(&step, &data);
  status = solve(&step, &data, memory, &guess, dq, dp, options ? options : &standard, report, memory + MEMORY);
  if (status != KEPLER_SVI_4_OK)
    return status;
  if (!reaches(q0, dq) || !reaches(p0, dp))
    return KEPLER_SVI_4_NOT_FINITE;
  report->steps = 1;
  for (int i = 0; i < M; i++) {
    q1[i] = q0[i] + (dq[i] + dq[M + i]);
    p1[i] = p0[i] + (dp[i] + dp[M + i]);
  }
  return KEPLER_SVI_4_OK;
}

void kepler_svi_4_start(kepler_svi_4_run *run, double t, double h, const double *q, const double *p)
{
  memset(run, 0, sizeof *run);
  run->t = t;
  run->h = h;
  memcpy(run->q, q, sizeof(double) * M);
  memcpy(run->p, p, sizeof(double) * M);
}

/* What a step changes, at hand while a call lasts. */
typedef struct {
  double q[M], p[M], carry_q[M], carry_p[M];
} state;

static void load_state(const kepler_svi_4_run *run, state *now)
{
  memcpy(now->q, run->q, sizeof now->q);
  memcpy(now->p, run->p, sizeof now->p);
  memcpy(now->carry_q, run->carry_q, sizeof now->carry_q);
  memcpy(now->carry_p, run->carry_p, sizeof now->carry_p);
}

static void save_state(const state *now, kepler_svi_4_run *run)
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

/* t + t_low += h, in twice the precision: after any number of steps t is their exact sum, rounded. */
static void add_to_time(double *t, double *t_low, double h)
{
  const double sum = *t + h, part = sum - *t;
  const double rest = ((*t - (sum - part)) + (h - part)) + *t_low;
  *t = sum + rest;
  *t_low = rest - (*t - sum);
}

int kepler_svi_4_advance(kepler_svi_4_run *run, long long steps, long long every, const double *parameters,
    const kepler_svi_4_options *options, double *t, double *q, double *p, int *iterations,
    kepler_svi_4_report *report, double *workspace)
{
  const kepler_svi_4_options standard = kepler_svi_4_default_options();
  state now;
  step_data step = {run->t, run->h, now.q, now.p, now.carry_q, now.carry_p, parameters, workspace, 1};
  kepler_svi_4_report unread;
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
    report->t = step.t = run->t;
    status = solve(&step, &data, run->memory, &run->guess, dq, dp, options ? options : &standard, report,
        workspace + SCRATCH);
    if (status == KEPLER_SVI_4_OK && (!reaches(now.q, dq) || !reaches(now.p, dp)))
      status = KEPLER_SVI_4_NOT_FINITE;
    if (status != KEPLER_SVI_4_OK) {
      save_state(&now, run);
      return status;
    }
    add_compensated(now.q, now.carry_q, dq);
    add_compensated(now.p, now.carry_p, dp);
    run->iterations += report->iterations - before;
    run->step++;
    add_to_time(&run->t, &run->t_low, run->h);
    report->steps++;
    if (run->step % every == 0) {
      t[stored] = run->t;
      memcpy(q + stored * M, now.q, sizeof(double) * M);
      memcpy(p + stored * M, now.p, sizeof(double) * M);
      iterations[stored] = (int)run->iterations;
      run->iterations = 0;
      stored++;
    }
  }
  save_state(&now, run);
  return KEPLER_SVI_4_OK;
}

/* h^1 sum_n w_n lagrangian along the curve given by z. */
static double quadrature_sum(const step_data *step, const double *z)
{
  const double h = step->h;
  double *u = step->scratch, sum = 0.0;
  gather(QUADRATURE_GATHER_0[0], 4, h, z, u + 0, 4, 1);
  offset(step, 4, u + 0, 4);
  gather(QUADRATURE_GATHER_1[0], 4, 1.0, z, u + 2, 4, 1);
  for (int n = 0; n < 4; n++) {
    double value[1];
    lagrangian(u + n * 4, step->parameters, value);
    sum += QUADRATURE_WEIGHT[n] * value[0];
  }
  return h * sum;
}

int kepler_svi_4_discrete_legendre(double t, double h, const double *q0, const double *q1, const double *parameters,
    const kepler_svi_4_options *options, double *p0, double *p1, double *action, kepler_svi_4_report *report,
    double *workspace)
{
  const kepler_svi_4_options standard = kepler_svi_4_default_options();
  const double carry_q[M] = {0.0};
  kepler_svi_4_report unread;
  const newton_data data = newton_in(workspace + SCRATCH);
  double v[M], start_p[M], increment[M];
  const step_data step = {t, h, q0, start_p, carry_q, carry_q, parameters, workspace, 1};
  int keep = 0, status;
  report = report ? report : &unread;
  memset(report, 0, sizeof *report);
  for (int i = 0; i < M; i++)
    v[i] = (q1[i] - q0[i]) / h;
  status = kepler_svi_4_momentum(t, q0, v, parameters, start_p, workspace);
  for (int i = 0; i < M; i++)
    for (int b = 0; b < B; b++)
      data.z[i * B + b] = STRAIGHT[b] * v[i];
  if (status == KEPLER_SVI_4_OK)
    status = newton(&step, &data, q1, start_p, increment, &keep, options ? options : &standard, report);
  if (status != KEPLER_SVI_4_OK)
    return status;
  for (int i = 0; i < M; i++) {
    p0[i] = start_p[i];
    p1[i] = start_p[i] + increment[i];
  }
  *action = quadrature_sum(&step, data.z);
  return KEPLER_SVI_4_OK;
}
