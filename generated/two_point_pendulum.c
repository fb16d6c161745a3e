/* planar pendulum: Spectral-collocation variational integrator, degree 1, chebyshev-lobatto nodes, gauss-legendre:2; see two_point_pendulum.h. */
#include "two_point_pendulum.h"

#include <float.h>
#include <math.h>
#include <string.h>

enum {
  M = 1, /* coordinates */
  B = 1, /* blocks of M unknowns */
  N = B * M,
  MEMORY = 4, /* numbers kept from step to step */
  SCRATCH = 2 /* slopes of the largest kernel, or the mass matrix with its slopes */
};

/* Everything a step is made from. */
typedef struct {
  double t, h;
  const double *q0, *p0, *carry_q, *carry_p, *parameters;
  double *scratch; /* SCRATCH numbers */
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

/* q1 = q0 + h sum_b END_POSITION[b] z_b; row r holds MOMENTUM_ROW[r] p0; the straight-line guess of z_b is STRAIGHT[b] v0,
 * the guess from the step before sum_c EXTRAPOLATION[b][c] z_c. */
static const double END_POSITION[1] = {
  1.0
};

static const double MOMENTUM_ROW[1] = {
  1.0
};

static const double STRAIGHT[1] = {
  1.0
};

static const double EXTRAPOLATION[1][1] = {
  {1.0}
};


/* Quadrature: 2 points.
 * Gather tables have one column a block, scatter tables one column a row and a last one for p1. */
static const double QUADRATURE_WEIGHT[2] = {
  0.5, 0.5
};

static const double QUADRATURE_GATHER_0[2][1] = {
  {0.21132486540518713},
  {0.7886751345948129}
};

static const double QUADRATURE_GATHER_1[2][1] = {
  {1.0},
  {1.0}
};

static const double QUADRATURE_SCATTER_0[2][2] = {
  {0.7886751345948129, 1.0},
  {0.21132486540518713, 1.0}
};

static const double QUADRATURE_SCATTER_1[2][2] = {
  {-1.0, 0.0},
  {-1.0, 0.0}
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
  const double w1 = parameters[0]*(parameters[1]*parameters[1]);
  value[0] = -(w0*sin(u[0]));
  value[1] = w1*u[1];
  slope[0] = -(w0*cos(u[0]));
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

/* LU factors of the n x n matrix a, rows exchanged so that every pivot is the largest of its column. Returns 0 if one
 * vanishes or is not a number; pivot[k] is the row exchanged with k. */
static int factorise(double *a, int n, double *pivot)
{
  for (int k = 0; k < n; k++) {
    int best = k;
    for (int i = k + 1; i < n; i++)
      if (fabs(a[i * n + k]) > fabs(a[best * n + k]))
        best = i;
    pivot[k] = (double)best;
    if (!(fabs(a[best * n + k]) > 0.0))
      return 0;
    for (int j = 0; best != k && j < n; j++) {
      const double exchanged = a[k * n + j];
      a[k * n + j] = a[best * n + j];
      a[best * n + j] = exchanged;
    }
    for (int i = k + 1; i < n; i++) {
      const double factor = a[i * n + k] / a[k * n + k];
      a[i * n + k] = factor;
      if (factor != 0.0)
        for (int j = k + 1; j < n; j++)
          a[i * n + j] -= factor * a[k * n + j];
    }
  }
  return 1;
}

/* x = a^-1 x with the factors of a. */
static void back_substitute(const double *a, int n, const double *pivot, double *x)
{
  for (int k = 0; k < n; k++) {
    const int best = (int)pivot[k];
    const double exchanged = x[best];
    x[best] = x[k];
    x[k] = exchanged;
  }
  for (int i = 1; i < n; i++)
    for (int j = 0; j < i; j++)
      x[i] -= a[i * n + j] * x[j];
  for (int i = n - 1; i >= 0; i--) {
    for (int j = i + 1; j < n; j++)
      x[i] -= a[i * n + j] * x[j];
    x[i] /= a[i * n + i];
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

/* Momenta at u = (q, v), and the mass matrix dp/dv in the first M M numbers of scratch. */
static void momentum_and_mass(double t, const double *u, const double *parameters, double *value, double *scratch)
{
  double *mass = scratch, *slope = scratch + M * M;
  (void)t;
  legendre(u, parameters, value, slope);
  memset(mass, 0, sizeof(double) * (size_t)(M * M));
  for (int e = 0; e < 1; e++)
    mass[MASS_ENTRY[e][0] * M + MASS_ENTRY[e][1]] = slope[e];
}

/* max |value - p|. */
static double largest_misfit(const double *value, const double *p)
{
  double largest = 0.0;
  for (int i = 0; i < M; i++)
    largest = larger(largest, fabs(value[i] - p[i]));
  return largest;
}

int two_point_pendulum_momentum(double t, const double *q, const double *v, const double *parameters, double *p,
    double *workspace)
{
  double u[2 * M], value[M];
  memcpy(u, q, sizeof(double) * M);
  memcpy(u + M, v, sizeof(double) * M);
  momentum_and_mass(t, u, parameters, value, workspace);
  if (!all_finite(value, M))
    return TWO_POINT_PENDULUM_NOT_FINITE;
  memcpy(p, value, sizeof(double) * M);
  return TWO_POINT_PENDULUM_OK;
}

/* Newton's iteration for L_v(q, v) = p from the velocity in u, halving updates that leave the domain or do not bring p
 * nearer. */
static int invert_momentum(double t, double *u, const double *p, const double *parameters, double *mass)
{
  double value[M], update[M], pivot[M], misfit;
  momentum_and_mass(t, u, parameters, value, mass);
  misfit = largest_misfit(value, p);
  for (int k = 0; k < 50; k++) {
    double scale = 1.0, nearer, start[M], roundoff = 0.0;
    if (!all_finite(value, M) || !all_finite(mass, M * M))
      return TWO_POINT_PENDULUM_NOT_FINITE;
    if (misfit == 0.0)
      return TWO_POINT_PENDULUM_OK;
    if (!factorise(mass, M, pivot))
      return TWO_POINT_PENDULUM_SINGULAR;
    for (int i = 0; i < M; i++) {
      update[i] = p[i] - value[i];
      roundoff = larger(roundoff, 64.0 * DBL_EPSILON * fabs(p[i]));
    }
    back_substitute(mass, M, pivot, update);
    memcpy(start, u + M, sizeof(double) * M);
    do {
      for (int i = 0; i < M; i++)
        u[M + i] = start[i] + scale * update[i];
      momentum_and_mass(t, u, parameters, value, mass);
      nearer = all_finite(value, M) ? largest_misfit(value, p) : INFINITY;
      scale *= 0.5;
    } while (!(nearer < misfit) && misfit > roundoff && scale > DBL_EPSILON);
    if (!(nearer < misfit)) { /* round-off: keep the better velocity */
      memcpy(u + M, start, sizeof(double) * M);
      return misfit <= roundoff ? TWO_POINT_PENDULUM_OK : TWO_POINT_PENDULUM_NOT_CONVERGED;
    }
    misfit = nearer;
  }
  return TWO_POINT_PENDULUM_NOT_CONVERGED;
}

int two_point_pendulum_velocity(double t, const double *q, const double *p, const double *parameters, double *v,
    double *workspace)
{
  int status = TWO_POINT_PENDULUM_SINGULAR;
  for (int attempt = 0; attempt < 3; attempt++) { /* from rest, from v = p, from v = 1 */
    double u[2 * M];
    for (int i = 0; i < M; i++) {
      u[i] = q[i];
      u[M + i] = attempt == 0 ? 0.0 : attempt == 1 ? p[i] : 1.0;
    }
    status = invert_momentum(t, u, p, parameters, workspace);
    if (status == TWO_POINT_PENDULUM_OK) {
      memcpy(v, u + M, sizeof(double) * M);
      return status;
    }
  }
  return status;
}

int two_point_pendulum_energy(double t, const double *q, const double *p, const double *parameters, double *energy,
    double *workspace)
{
  double u[2 * M], value[1], sum;
  const int status = two_point_pendulum_velocity(t, q, p, parameters, u + M, workspace);
  if (status != TWO_POINT_PENDULUM_OK)
    return status;
  memcpy(u, q, sizeof(double) * M);
  lagrangian(u, parameters, value);
  sum = -value[0];
  for (int i = 0; i < M; i++)
    sum += p[i] * u[M + i];
  if (!all_finite(&sum, 1))
    return TWO_POINT_PENDULUM_NOT_FINITE;
  *energy = sum;
  return TWO_POINT_PENDULUM_OK;
}

int two_point_pendulum_energies(long long count, const double *t, const double *q, const double *p, const double *parameters,
    double *energy, double *workspace)
{
  for (long long k = 0; k < count; k++) {
    const int status = two_point_pendulum_energy(t[k], q + k * M, p + k * M, parameters, energy + k, workspace);
    if (status != TWO_POINT_PENDULUM_OK)
      return status;
  }
  return TWO_POINT_PENDULUM_OK;
}

/* u = scale sum_b row[b] z_b, M numbers. */
static void gather(const double *row, double scale, const double *z, double *u)
{
  for (int i = 0; i < M; i++) {
    double sum = 0.0;
    for (int b = 0; b < B; b++)
      sum += row[b] * z[b * M + i];
    u[i] = scale * sum;
  }
}

/* u = q0 + u, with what rounding cut off q0 before. */
static void offset(const step_data *step, double *u)
{
  for (int i = 0; i < M; i++)
    u[i] = step->q0[i] + (step->carry_q[i] + u[i]);
}

/* rows_r += scale row[r] value; the last row is p1, whose terms are also summed without sign into size. */
static void scatter(const double *row, double scale, const double *value, double *rows, double *size)
{
  for (int r = 0; r <= B; r++)
    for (int i = 0; i < M; i++)
      rows[r * M + i] += row[r] * (scale * value[i]);
  for (int i = 0; i < M; i++)
    size[i] += fabs(row[B] * (scale * value[i]));
}

/* Adds scale row[r] slope_e column[b] to the Jacobian entry of row (r, i_e) and column (b, j_e). */
static void scatter_slope(const double *row, const double *column, double scale, const int (*entry)[2], int count,
    const double *slope, double *jacobian, int stride)
{
  for (int r = 0; r < B; r++) {
    for (int b = 0; b < B; b++) {
      const double factor = scale * row[r] * column[b];
      double *block = jacobian + (r * M) * stride + b * M;
      if (factor != 0.0)
        for (int e = 0; e < count; e++)
          block[entry[e][0] * stride + entry[e][1]] += factor * slope[e];
    }
  }
}

/* Quadrature points: their part of the rows, and of the Jacobian unless it is NULL. */
static void add_quadrature(const step_data *step, const double *z, double *rows, double *size, double *jacobian, int stride)
{
  const double h = step->h;
  for (int n = 0; n < 2; n++) {
    double u[2], value[2];
    gather(QUADRATURE_GATHER_0[n], h, z, u + 0);
    offset(step, u + 0);
    gather(QUADRATURE_GATHER_1[n], 1.0, z, u + 1);
    if (jacobian) {
      double *slope = step->scratch;
      quadrature_slope(u, step->parameters, value, slope);
      scatter_slope(QUADRATURE_SCATTER_0[n], QUADRATURE_GATHER_0[n], QUADRATURE_WEIGHT[n] * h*h,
          QUADRATURE_SLOPE_0, 1, slope + 0, jacobian, stride);
      scatter_slope(QUADRATURE_SCATTER_1[n], QUADRATURE_GATHER_1[n], QUADRATURE_WEIGHT[n] * 1.0,
          QUADRATURE_SLOPE_1, 1, slope + 1, jacobian, stride);
    } else {
      quadrature_value(u, step->parameters, value);
    }
    scatter(QUADRATURE_SCATTER_0[n], QUADRATURE_WEIGHT[n] * h, value + 0, rows, size);
    scatter(QUADRATURE_SCATTER_1[n], QUADRATURE_WEIGHT[n] * 1.0, value + 1, rows, size);
  }
}

/* The stage equations: rows (B M residuals, then p1 - p0), the sizes of p1 and q1 before cancellation, the Jacobian. */
static void evaluate(const step_data *step, const double *z, double *rows, double *size_p, double *size_q,
    double *jacobian, int stride)
{
  for (int r = 0; r < B; r++)
    for (int i = 0; i < M; i++)
      rows[r * M + i] = MOMENTUM_ROW[r] * step->p0[i];
  for (int i = 0; i < M; i++) {
    rows[N + i] = 0.0;
    size_p[i] = fabs(step->p0[i]);
    size_q[i] = fabs(step->q0[i]);
    for (int b = 0; b < B; b++)
      size_q[i] += fabs(step->h * END_POSITION[b] * z[b * M + i]);
  }
  if (jacobian)
    memset(jacobian, 0, sizeof(double) * (size_t)(stride * stride));
  add_quadrature(step, z, rows, size_p, jacobian, stride);
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

static void measure_stages(movement *moved, const step_data *step, const double *update, const double *size_q)
{
  double change[M];
  for (int i = 0; i < M; i++) {
    change[i] = 0.0;
    for (int b = 0; b < B; b++)
      change[i] = larger(change[i], fabs(step->h * update[b * M + i]));
  }
  measure(moved, change, size_q);
}

static void measure_momentum(movement *moved, const double *increment, const double *last_increment,
    const double *size_p)
{
  double change[M];
  for (int i = 0; i < M; i++)
    change[i] = increment[i] - last_increment[i];
  measure(moved, change, size_p);
}

/* Whether the iterate that `moved` led to is accepted: its update is below the tolerance, or at round-off level and no
 * longer shrinking. */
static int has_converged(const two_point_pendulum_options *options, const movement *moved, double last)
{
  if (options->absolute)
    return moved->absolute < options->tolerance;
  return moved->relative <= options->tolerance
      || (moved->overall <= 1e-11 && moved->relative >= 0.25 * last);
}

/* The rows q0 + h sum_b beta_b z_b = q1 behind the stage equations, with p0 as further unknown. */
static void add_boundary(const step_data *step, const double *z, const double *q1, double *rows, double *jacobian)
{
  for (int i = 0; i < M; i++) {
    rows[N + i] = -(q1[i] - step->q0[i]) / step->h;
    for (int b = 0; b < B; b++)
      rows[N + i] += END_POSITION[b] * z[b * M + i];
  }
  if (jacobian)
    for (int b = 0; b < B; b++)
      for (int i = 0; i < M; i++) {
        jacobian[(b * M + i) * (N + M) + N + i] = MOMENTUM_ROW[b];
        jacobian[(N + i) * (N + M) + b * M + i] = END_POSITION[b];
      }
}

/* Newton's iteration on the stage equations from the guess in z; on success z and p1 - p0 belong together. Once the
 * updates are small the factors are kept. With an end position q1, p0 is unknown too and found in place. */
static int newton(const step_data *step, double *z, const double *q1, double *p0, double *increment,
    const two_point_pendulum_options *options, two_point_pendulum_report *report, double *workspace)
{
  const int size = q1 ? N + M : N;
  double *jacobian = workspace, *update = jacobian + size * size, *pivot = update + size, *rows = pivot + size;
  double size_q[M], size_p[M], last_increment[M], last = INFINITY;
  movement moved = no_movement();
  int keep = 0;
  memset(increment, 0, sizeof(double) * M);
  for (int k = 0;; k++) {
    evaluate(step, z, rows, size_p, size_q, keep ? NULL : jacobian, size);
    memcpy(last_increment, increment, sizeof(double) * M);
    memcpy(increment, rows + N, sizeof(double) * M);
    if (q1)
      add_boundary(step, z, q1, rows, keep ? NULL : jacobian);
    if (!all_finite(rows, size) || !all_finite(increment, M))
      return TWO_POINT_PENDULUM_NOT_FINITE;
    if (k > 0) {
      measure_momentum(&moved, increment, last_increment, size_p);
      report->change = options->absolute ? moved.absolute : moved.relative;
      if (has_converged(options, &moved, last))
        return TWO_POINT_PENDULUM_OK;
      last = moved.relative;
    }
    if (k >= options->max_iterations)
      return TWO_POINT_PENDULUM_NOT_CONVERGED;
    if (!keep && !factorise(jacobian, size, pivot))
      return TWO_POINT_PENDULUM_SINGULAR;
    memcpy(update, rows, sizeof(double) * (size_t)size);
    back_substitute(jacobian, size, pivot, update);
    for (int i = 0; i < N; i++)
      z[i] -= update[i];
    moved = no_movement();
    measure_stages(&moved, step, update, size_q);
    for (int i = 0; q1 && i < M; i++)
      p0[i] -= update[N + i];
    if (q1)
      measure(&moved, update + N, size_p);
    keep = moved.overall < 1e-05 && moved.relative < 0.1 * last;
    report->iterations++;
  }
}

#ifdef __GNUC__
/* Vectors of points. GCC and Clang map them to whatever the processor has. */
#pragma GCC diagnostic ignored "-Wpsabi" /* everything that takes a vector is static */

enum { LANES = 2 };
typedef double lanes __attribute__((vector_size(8 * 2)));
typedef union {
  lanes all;
  double lane[LANES];
} lane_view;

static inline lanes lanes_of(double x)
{
  const lanes zero = {0.0};
  return zero + x;
}

/* Whole vectors by glibc's libmvec where SCVI_LIBMVEC says that it is linked, else lane by lane. */
#if defined(SCVI_LIBMVEC) && defined(__x86_64__)
#if defined(__AVX512F__) && 2 >= 8
#define SCVI_PART 8
#define SCVI_NAME(f, arguments) _ZGVeN8##arguments##_##f
#elif defined(__AVX2__) && 2 >= 4
#define SCVI_PART 4
#define SCVI_NAME(f, arguments) _ZGVdN4##arguments##_##f
#else
#define SCVI_PART 2
#define SCVI_NAME(f, arguments) _ZGVbN2##arguments##_##f
#endif
typedef double sin_part __attribute__((vector_size(8 * SCVI_PART)));
sin_part SCVI_NAME(sin, v)(sin_part);
static inline lanes lanes_sin(lanes x)
{
  union {
    lanes all;
    sin_part part[LANES / SCVI_PART];
  } view = {x};
  for (int j = 0; j < LANES / SCVI_PART; j++)
    view.part[j] = SCVI_NAME(sin, v)(view.part[j]);
  return view.all;
}
#undef SCVI_PART
#undef SCVI_NAME
#else
static inline lanes lanes_sin(lanes x)
{
  lane_view view = {x};
  for (int j = 0; j < LANES; j++)
    view.lane[j] = sin(view.lane[j]);
  return view.all;
}
#endif

/* Column j of a table multiplies point j: POINT_x holds what one point gives to all. Lanes beyond point 2 repeat it.
 * The method's numbers are those here and in the _LOW tables together. */
static const lanes POINT_DRIFT = {0.21132486540518713, 0.7886751345948129};
static const lanes POINT_DRIFT_LOW = {0.0, 0.0};
static const lanes POINT_PRODUCT[2] = {
  {0.08333333333333334, 0.3110042339640731},
  {0.022329099369260228, 0.08333333333333334}
};
static const lanes POINT_PRODUCT_LOW[2] = {
  {-4.423726391208987e-18, -2.3331849224419927e-17},
  {9.542794392553726e-19, -4.423726391208987e-18}
};
static const lanes POINT_END_POSITION = {0.39433756729740643, 0.10566243270259357};
static const lanes POINT_END_POSITION_LOW = {0.0, 0.0};
static const lanes POINT_END_MOMENTUM = {0.5, 0.5};
static const lanes POINT_END_MOMENTUM_LOW = {0.0, 0.0};

/* From the forces of the last step and of the one before to the product with the forces of the next. */
static const lanes LAST_ALONE[2] = {
  {-0.099679368558886, -0.37200846792814624},
  {0.20534180126147958, 0.7663460352255527}
};
static const lanes LAST[2] = {
  {-0.08851481887425589, -0.33034180126147955},
  {0.24700846792814624, 0.9218481522075892}
};
static const lanes BEFORE[2] = {
  {0.08034180126147955, 0.299839684279443},
  {-0.13317301761277633, -0.49700846792814624}
};

/* sum_j table[j] x_j, in four sums that do not wait for each other. */
static inline lanes lanes_apply(const lanes *table, lanes x)
{
  const lane_view view = {x};
  lanes a = table[0] * view.lane[0];
  for (int j = 1; j < LANES; j++)
    a += table[j] * view.lane[j];
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

/* What is kept at the points, continued into this step from the last one or from the last two. */
static inline void continue_curve(const double *memory, long long steps, lanes *x)
{
  lanes before[M];
  lanes_load(memory, x);
  lanes_load(memory + M * LANES, before);
  for (int i = 0; i < M; i++)
    x[i] = steps == 1 ? lanes_apply(LAST_ALONE, x[i]) : lanes_apply(LAST, x[i]) + lanes_apply(BEFORE, before[i]);
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

/* L_q at all points. Operations: 3 *, 1 neg, 1 sin. */
static inline void force_lanes(const lanes *u, const double *parameters, lanes *value)
{
  value[0] = -(parameters[2]*parameters[1]*parameters[0]*lanes_sin(u[0]));
}

/* The constant masses, of the parameters alone. */
static void mass(const double *parameters, double *value)
{
  value[0] = parameters[0]*(parameters[1]*parameters[1]);
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
  mass(step->parameters, data->inverse_mass);
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

/* One step. The points X follow q0 + h c v0 + h^2 (a A) F / m until they rest; then once more, and the increments, with
 * all digits of the coefficients. Small terms are summed first: added to a rounded sum, they would be rounded away. The
 * forces stay in memory. */
static int sweep(const step_data *step, const sweep_data *data, double *memory, long long *steps, double *dq, double *dp,
    const two_point_pendulum_options *options, two_point_pendulum_report *report)
{
  lanes X[M], base[M], F[M];
  double drift[M], drift_low[M], inverse_size[M], first = 0.0, last = INFINITY, largest = 0.0;
  int status = 0;
  for (int i = 0; i < M; i++) {
    const double v = data->inverse_mass[i] * step->p0[i], v_low = fma(data->inverse_mass[i], step->p0[i], -v);
    drift[i] = step->h * v;
    drift_low[i] = fma(step->h, v, -drift[i]) + step->h * (v_low + data->inverse_mass[i] * step->carry_p[i]);
    base[i] = step->q0[i] + POINT_DRIFT * drift[i];
    inverse_size[i] = fabs(step->q0[i]) + fabs(drift[i]);
    largest = larger(largest, inverse_size[i]);
    X[i] = base[i];
  }
  for (int i = 0; i < M; i++)
    inverse_size[i] = options->absolute ? 1.0 : 1.0 / (inverse_size[i] + DBL_EPSILON * largest + DBL_MIN);
  if (*steps > 0) {
    continue_curve(memory, *steps, F);
    for (int i = 0; i < M; i++)
      X[i] += (data->square * data->inverse_mass[i]) * F[i];
  }
  force_lanes(X, step->parameters, F);
  for (int k = 0; status == 0; k++) {
    lanes change = lanes_of(0.0);
    double total;
    for (int i = 0; i < M; i++) {
      const lanes x = base[i] + (data->square * data->inverse_mass[i]) * lanes_apply(POINT_PRODUCT, F[i]);
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
    return last < INFINITY ? TWO_POINT_PENDULUM_NOT_CONVERGED : TWO_POINT_PENDULUM_NOT_FINITE;
  for (int i = 0; i < M; i++) {
    const lanes sum = lanes_apply(POINT_PRODUCT, F[i]), low = lanes_apply(POINT_PRODUCT_LOW, F[i]);
    const lanes small = step->carry_q[i] + POINT_DRIFT * drift_low[i] + POINT_DRIFT_LOW * drift[i];
    const lanes rest = data->inverse_mass[i] * (data->square * low + data->square_low * sum);
    X[i] = step->q0[i] + ((POINT_DRIFT * drift[i] + (small + rest)) + data->inverse_mass[i] * (data->square * sum));
  }
  force_lanes(X, step->parameters, F);
  for (int i = 0; i < M; i++) {
    const double sum = lanes_total(POINT_END_POSITION * F[i] + POINT_END_POSITION_LOW * F[i]);
    dp[i] = lanes_total(data->weight * F[i] + data->weight_low * F[i]);
    dq[i] = drift[i] + (drift_low[i] + data->inverse_mass[i] * (data->square * sum + data->square_low * sum));
  }
  if (!all_finite(dq, M) || !all_finite(dp, M))
    return TWO_POINT_PENDULUM_NOT_FINITE;
  remember_curve(F, memory);
  *steps = steps_to_continue(*steps, first);
  return TWO_POINT_PENDULUM_OK;
}
#endif

two_point_pendulum_options two_point_pendulum_default_options(void)
{
  const two_point_pendulum_options options = {2.220446049250313e-16, 50, 0};
  return options;
}

/* The guess that q moves on a straight line with its initial velocity. */
static int guess_straight(const step_data *step, double *z)
{
  double v[M];
  const int status = two_point_pendulum_velocity(step->t, step->q0, step->p0, step->parameters, v, step->scratch);
  for (int b = 0; status == TWO_POINT_PENDULUM_OK && b < B; b++)
    for (int i = 0; i < M; i++)
      z[b * M + i] = STRAIGHT[b] * v[i];
  return status;
}

/* The guess that the curve of the step before goes on. */
static void guess_extrapolated(const double *memory, double *z)
{
  for (int b = 0; b < B; b++)
    gather(EXTRAPOLATION[b], 1.0, memory, z + b * M);
}

/* The increments by Newton's iteration, from the extrapolated guess if there is one, and from the straight line if there
 * is none or it leads nowhere. */
static int solve_newton(const step_data *step, double *memory, int guess, double *dq, double *dp,
    const two_point_pendulum_options *options, two_point_pendulum_report *report, double *workspace)
{
  double *z = workspace;
  int status = TWO_POINT_PENDULUM_NOT_CONVERGED;
  if (guess) {
    guess_extrapolated(memory, z);
    status = newton(step, z, NULL, NULL, dp, options, report, z + N);
  }
  if (status != TWO_POINT_PENDULUM_OK) {
    status = guess_straight(step, z);
    if (status == TWO_POINT_PENDULUM_OK)
      status = newton(step, z, NULL, NULL, dp, options, report, z + N);
  }
  if (status == TWO_POINT_PENDULUM_OK) {
    gather(END_POSITION, step->h, z, dq);
    memcpy(memory, z, sizeof(double) * N);
  }
  return status;
}
#ifdef __GNUC__
typedef sweep_data solver_data;

static void prepare(const step_data *step, solver_data *data)
{
  prepare_sweep(step, data);
}

/* The increments by sweeps, from the curve of the last two steps continued and then from the straight line, else by
 * Newton's iteration. On success guess says from how many steps the next is continued. */
static int solve(const step_data *step, const solver_data *data, double *memory, long long *guess, double *dq, double *dp,
    const two_point_pendulum_options *options, two_point_pendulum_report *report, double *workspace)
{
  long long steps = *guess;
  int status = sweep(step, data, memory, &steps, dq, dp, options, report);
  if (status != TWO_POINT_PENDULUM_OK && steps > 0) {
    steps = 0;
    status = sweep(step, data, memory, &steps, dq, dp, options, report);
  }
  if (status != TWO_POINT_PENDULUM_OK) {
    steps = 0;
    status = solve_newton(step, workspace, 0, dq, dp, options, report, workspace + MEMORY);
  }
  if (status == TWO_POINT_PENDULUM_OK)
    *guess = steps;
  return status;
}
#else
typedef struct {
  int unused;
} solver_data;

static void prepare(const step_data *step, solver_data *data)
{
  (void)step;
  data->unused = 0;
}

static int solve(const step_data *step, const solver_data *data, double *memory, long long *guess, double *dq, double *dp,
    const two_point_pendulum_options *options, two_point_pendulum_report *report, double *workspace)
{
  const int status = solve_newton(step, memory, *guess != 0, dq, dp, options, report, workspace + MEMORY);
  (void)data;
  if (status == TWO_POINT_PENDULUM_OK)
    *guess = 1;
  return status;
}
#endif

int two_point_pendulum_step(double t, double h, const double *q0, const double *p0, const double *parameters,
    const two_point_pendulum_options *options, double *q1, double *p1, two_point_pendulum_report *report, double *workspace)
{
  const two_point_pendulum_options standard = two_point_pendulum_default_options();
  const double nothing[M] = {0.0};
  const step_data step = {t, h, q0, p0, nothing, nothing, parameters, workspace};
  two_point_pendulum_report unread;
  solver_data data;
  double *memory = workspace + SCRATCH, dq[M], dp[M];
  long long guess = 0;
  int status;
  report = report ? report : &unread;
  memset(report, 0, sizeof *report);
  report->t = t;
  prepare(&step, &data);
  status = solve(&step, &data, memory, &guess, dq, dp, options ? options : &standard, report, memory + MEMORY);
  if (status != TWO_POINT_PENDULUM_OK)
    return status;
  report->steps = 1;
  for (int i = 0; i < M; i++) {
    q1[i] = q0[i] + dq[i];
    p1[i] = p0[i] + dp[i];
  }
  return TWO_POINT_PENDULUM_OK;
}

void two_point_pendulum_start(two_point_pendulum_run *run, double t, double h, const double *q, const double *p)
{
  memset(run, 0, sizeof *run);
  run->t0 = t;
  run->h = h;
  memcpy(run->q, q, sizeof(double) * M);
  memcpy(run->p, p, sizeof(double) * M);
}

/* x += increment, with what rounding cuts off in carry (Kahan). */
static void add_compensated(double *x, double *carry, const double *increment)
{
  for (int i = 0; i < M; i++) {
    const double term = increment[i] + carry[i], sum = x[i] + term;
    carry[i] = term - (sum - x[i]);
    x[i] = sum;
  }
}

int two_point_pendulum_advance(two_point_pendulum_run *run, long long steps, long long every, const double *parameters,
    const two_point_pendulum_options *options, double *t, double *q, double *p, int *iterations,
    two_point_pendulum_report *report, double *workspace)
{
  const two_point_pendulum_options standard = two_point_pendulum_default_options();
  step_data step = {run->t0, run->h, run->q, run->p, run->carry_q, run->carry_p, parameters, workspace};
  two_point_pendulum_report unread;
  solver_data data;
  long long stored = 0;
  double dq[M], dp[M];
  report = report ? report : &unread;
  memset(report, 0, sizeof *report);
  prepare(&step, &data);
  for (long long k = 0; k < steps; k++) {
    const long long before = report->iterations;
    int status;
    report->t = step.t = run->t0 + (double)run->step * run->h;
    status = solve(&step, &data, run->memory, &run->guess, dq, dp, options ? options : &standard, report,
        workspace + SCRATCH);
    if (status != TWO_POINT_PENDULUM_OK)
      return status;
    add_compensated(run->q, run->carry_q, dq);
    add_compensated(run->p, run->carry_p, dp);
    run->iterations += report->iterations - before;
    run->step++;
    report->steps++;
    if (run->step % every == 0) {
      t[stored] = run->t0 + (double)run->step * run->h;
      memcpy(q + stored * M, run->q, sizeof(double) * M);
      memcpy(p + stored * M, run->p, sizeof(double) * M);
      iterations[stored] = (int)run->iterations;
      run->iterations = 0;
      stored++;
    }
  }
  return TWO_POINT_PENDULUM_OK;
}

/* h sum_n w_n L along the curve given by z. */
static double action_sum(const step_data *step, const double *z)
{
  const double h = step->h;
  double sum = 0.0;
  for (int n = 0; n < 2; n++) {
    double u[2 * M], value[1];
    gather(QUADRATURE_GATHER_0[n], h, z, u + 0);
    offset(step, u + 0);
    gather(QUADRATURE_GATHER_1[n], 1.0, z, u + 1);
    lagrangian(u, step->parameters, value);
    sum += QUADRATURE_WEIGHT[n] * value[0];
  }
  return h * sum;
}

int two_point_pendulum_discrete_legendre(double t, double h, const double *q0, const double *q1, const double *parameters,
    const two_point_pendulum_options *options, double *p0, double *p1, double *action, two_point_pendulum_report *report,
    double *workspace)
{
  const two_point_pendulum_options standard = two_point_pendulum_default_options();
  const double carry_q[M] = {0.0};
  two_point_pendulum_report unread;
  double *z = workspace + SCRATCH, v[M], start_p[M], increment[M];
  const step_data step = {t, h, q0, start_p, carry_q, carry_q, parameters, workspace};
  int status;
  report = report ? report : &unread;
  memset(report, 0, sizeof *report);
  for (int i = 0; i < M; i++) {
    v[i] = (q1[i] - q0[i]) / h;
    for (int b = 0; b < B; b++)
      z[b * M + i] = STRAIGHT[b] * v[i];
  }
  status = two_point_pendulum_momentum(t, q0, v, parameters, start_p, workspace);
  if (status == TWO_POINT_PENDULUM_OK)
    status = newton(&step, z, q1, start_p, increment, options ? options : &standard, report, z + N);
  if (status != TWO_POINT_PENDULUM_OK)
    return status;
  for (int i = 0; i < M; i++) {
    p0[i] = start_p[i];
    p1[i] = start_p[i] + increment[i];
  }
  *action = action_sum(&step, z);
  return TWO_POINT_PENDULUM_OK;
}
