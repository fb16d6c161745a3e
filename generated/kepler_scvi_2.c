/* Kepler problem: Spectral-collocation variational integrator, degree 2, chebyshev-lobatto nodes, gauss-legendre:2; see kepler_scvi_2.h. */
#include "kepler_scvi_2.h"

#include <float.h>
#include <math.h>
#include <string.h>

enum {
  M = 2, /* coordinates */
  B = 5, /* blocks of M unknowns */
  N = B * M,
  MEMORY = 14, /* numbers kept from step to step */
  SCRATCH = 16 /* slopes of the largest kernel, or the mass matrix with its slopes */
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
static const double END_POSITION[5] = {
  1.0, 0.75, -0.25, 0.0, 0.0
};

static const double MOMENTUM_ROW[5] = {
  1.0, 0.75, -0.25, 0.0, 0.0
};

static const double STRAIGHT[5] = {
  1.0, 0.0, 0.0, 0.0, 0.0
};

static const double EXTRAPOLATION[5][5] = {
  {1.0, 1.0, 0.0, 0.0, 0.0},
  {0.0, -1.0, 2.0, 0.0, 0.0},
  {0.0, -2.0, 3.0, 0.0, 0.0},
  {0.0, 0.0, 0.0, 1.0, 0.0},
  {0.0, 0.0, 0.0, 0.0, 1.0}
};


/* Quadrature: 2 points.
 * Gather tables have one column a block, scatter tables one column a row and a last one for p1. */
static const double QUADRATURE_WEIGHT[2] = {
  0.5, 0.5
};

static const double QUADRATURE_GATHER_0[2][5] = {
  {0.21132486540518713, 0.11682698238722367, -0.09449788301796347, 0.0, 0.0},
  {0.7886751345948129, 0.5498396842794431, -0.2388354503153698, 0.0, 0.0}
};

static const double QUADRATURE_GATHER_1[2][5] = {
  {1.0, 0.6056624327025936, -0.39433756729740643, 0.0, 0.0},
  {1.0, 0.8943375672974064, -0.10566243270259355, 0.0, 0.0}
};

static const double QUADRATURE_SCATTER_0[2][6] = {
  {0.7886751345948129, 0.6331730176127763, -0.15550211698203653, 0.0, 0.0, 1.0},
  {0.21132486540518713, 0.20016031572055693, -0.01116454968463021, 0.0, 0.0, 1.0}
};

static const double QUADRATURE_SCATTER_1[2][6] = {
  {-1.0, -0.6056624327025936, 0.39433756729740643, 0.0, 0.0, 0.0},
  {-1.0, -0.8943375672974064, 0.10566243270259355, 0.0, 0.0, 0.0}
};

static const int QUADRATURE_SLOPE_0[4][2] = { /* {i, j}: d value_i / d u_j */
  {0, 0}, {0, 1}, {1, 0}, {1, 1}
};

static const int QUADRATURE_SLOPE_1[2][2] = { /* {i, j}: d value_i / d u_j */
  {0, 0}, {1, 1}
};

/* Node: 2 points.
 * Gather tables have one column a block, scatter tables one column a row and a last one for p1. */
static const double NODE_GATHER_0[2][5] = {
  {0.5, 0.3125, -0.1875, 0.0, 0.0},
  {1.0, 0.75, -0.25, 0.0, 0.0}
};

static const double NODE_GATHER_1[2][5] = {
  {1.0, 0.75, -0.25, 0.0, 0.0},
  {1.0, 1.0, 0.0, 0.0, 0.0}
};

static const double NODE_GATHER_2[2][5] = {
  {0.0, 1.0, 0.0, 0.0, 0.0},
  {0.0, 0.0, 1.0, 0.0, 0.0}
};

static const double NODE_GATHER_3[2][5] = {
  {0.0, 0.0, 0.0, 1.0, 0.0},
  {0.0, 0.0, 0.0, 0.0, 1.0}
};

static const double NODE_SCATTER_0[2][6] = {
  {0.5, 0.4375, -0.0625, 0.0, 0.0, 1.0},
  {0.0, 0.0, 0.0, 0.0, 0.0, 1.0}
};

static const double NODE_SCATTER_1[2][6] = {
  {-1.0, -0.75, 0.25, 0.0, 0.0, 0.0},
  {-1.0, -1.0, 0.0, 0.0, 0.0, 0.0}
};

static const double NODE_SCATTER_2[2][6] = {
  {0.0, -1.0, 0.0, 0.0, 0.0, 0.0},
  {0.0, 0.0, -1.0, 0.0, 0.0, 0.0}
};

static const double NODE_SCATTER_3[2][6] = {
  {0.0, 0.0, 0.0, -1.0, 0.0, 0.0},
  {0.0, 0.0, 0.0, 0.0, -1.0, 0.0}
};

static const int NODE_SLOPE_0[4][2] = { /* {i, j}: d value_i / d u_j */
  {0, 0}, {0, 1}, {1, 0}, {1, 1}
};

static const int NODE_SLOPE_1[4][2] = { /* {i, j}: d value_i / d u_j */
  {0, 0}, {0, 1}, {1, 0}, {1, 1}
};

static const int NODE_SLOPE_2[2][2] = { /* {i, j}: d value_i / d u_j */
  {0, 0}, {1, 1}
};

static const int NODE_SLOPE_3[4][2] = { /* {i, j}: d value_i / d u_j */
  {0, 0}, {0, 1}, {1, 0}, {1, 1}
};

static const int NODE_SLOPE_4[2][2] = { /* {i, j}: d value_i / d u_j */
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

/* x^(-7/2) */
static inline double inverse_root_7(double x)
{
  const double inverse = 1.0/x;
  return inverse*inverse*inverse*inverse*sqrt(x);
}

/* L_q and L_v at u = (q, v). Operations: 5 *, 1 +, 1 inverse_root_3, 2 neg. */
static void quadrature_value(const double *u, const double *parameters, double *value)
{
  const double w0 = parameters[0]*inverse_root_3(u[0]*u[0] + u[1]*u[1]);
  value[0] = -(w0*u[0]);
  value[1] = -(w0*u[1]);
  value[2] = u[2];
  value[3] = u[3];
}

/* The same, and the non-zero derivatives with respect to u = (q, v). Operations: 13 *, 1 +, 2 -, 1 inverse_root_3, 1 inverse_root_5, 4 neg. */
static void quadrature_slope(const double *u, const double *parameters, double *value, double *slope)
{
  const double w0 = u[0]*u[0];
  const double w1 = u[1]*u[1];
  const double w2 = w0 + w1;
  const double w3 = parameters[0]*inverse_root_3(w2);
  const double w4 = inverse_root_5(w2);
  const double w5 = 3.0*parameters[0];
  const double w6 = w5*w4*u[0]*u[1];
  value[0] = -(w3*u[0]);
  value[1] = -(w3*u[1]);
  value[2] = u[2];
  value[3] = u[3];
  slope[0] = -(w3 - w5*w0*w4);
  slope[1] = w6;
  slope[2] = w6;
  slope[3] = -(w3 - w5*w1*w4);
  slope[4] = 1.0;
  slope[5] = 1.0;
}

/* Derivatives of lambda . E at u = (q, v, a, lambda). Operations: 21 *, 3 +, 4 -, 1 inverse_root_3, 1 inverse_root_5. */
static void node_value(const double *u, const double *parameters, double *value)
{
  const double w0 = u[0]*u[0];
  const double w1 = u[1]*u[1];
  const double w2 = w0 + w1;
  const double w3 = parameters[0]*inverse_root_3(w2);
  const double w4 = inverse_root_5(w2);
  const double w5 = 3.0*parameters[0];
  const double w6 = w5*w4;
  value[0] = w3*u[6] - w5*w0*w4*u[6] - w6*u[0]*u[1]*u[7];
  value[1] = w3*u[7] - w5*w1*w4*u[7] - w6*u[6]*u[0]*u[1];
  value[2] = 0.0;
  value[3] = 0.0;
  value[4] = u[6];
  value[5] = u[7];
  value[6] = w3*u[0] + u[4];
  value[7] = w3*u[1] + u[5];
}

/* The same, and the non-zero derivatives with respect to u = (q, v, a, lambda). Operations: 55 *, 6 +, 12 -, 1 inverse_root_3, 1 inverse_root_5, 1 inverse_root_7, 1 neg. */
static void node_slope(const double *u, const double *parameters, double *value, double *slope)
{
  const double w0 = u[0]*u[0];
  const double w1 = u[1]*u[1];
  const double w2 = w0 + w1;
  const double w3 = parameters[0]*inverse_root_3(w2);
  const double w4 = inverse_root_5(w2);
  const double w5 = parameters[0]*w4;
  const double w6 = 3.0*parameters[0];
  const double w7 = w6*w0*w4;
  const double w8 = w6*w4;
  const double w9 = w8*u[0]*u[1];
  const double w10 = w5*u[6];
  const double w11 = w6*w1*w4;
  const double w12 = w8*u[6]*u[0];
  const double w13 = inverse_root_7(w2);
  const double w14 = 5.0*parameters[0];
  const double w15 = w14*w0*w13;
  const double w16 = w14*w1*w13;
  const double w17 = (-3.0)*(w5*u[0]*u[7] + w10*u[1] - w16*u[0]*u[7] - w15*u[6]*u[1]);
  const double w18 = w3 - w7;
  const double w19 = -w9;
  const double w20 = w3 - w11;
  value[0] = w3*u[6] - w7*u[6] - w9*u[7];
  value[1] = w3*u[7] - w11*u[7] - w12*u[1];
  value[2] = 0.0;
  value[3] = 0.0;
  value[4] = u[6];
  value[5] = u[7];
  value[6] = w3*u[0] + u[4];
  value[7] = w3*u[1] + u[5];
  slope[0] = (-3.0)*(w12 + w5*u[1]*u[7] - w14*(w0*u[0])*w13*u[6] - w15*u[1]*u[7]);
  slope[1] = w17;
  slope[2] = w17;
  slope[3] = (-3.0)*(w10*u[0] + w8*u[1]*u[7] - w14*w13*(w1*u[1])*u[7] - w16*u[6]*u[0]);
  slope[4] = w18;
  slope[5] = w19;
  slope[6] = w19;
  slope[7] = w20;
  slope[8] = 1.0;
  slope[9] = 1.0;
  slope[10] = w18;
  slope[11] = w19;
  slope[12] = w19;
  slope[13] = w20;
  slope[14] = 1.0;
  slope[15] = 1.0;
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

/* Momenta at u = (q, v), and the mass matrix dp/dv in the first M M numbers of scratch. */
static void momentum_and_mass(double t, const double *u, const double *parameters, double *value, double *scratch)
{
  double *mass = scratch, *slope = scratch + M * M;
  (void)t;
  (void)parameters;
  legendre(u, value, slope);
  memset(mass, 0, sizeof(double) * (size_t)(M * M));
  for (int e = 0; e < 2; e++)
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

int kepler_scvi_2_momentum(double t, const double *q, const double *v, const double *parameters, double *p,
    double *workspace)
{
  double u[2 * M], value[M];
  memcpy(u, q, sizeof(double) * M);
  memcpy(u + M, v, sizeof(double) * M);
  momentum_and_mass(t, u, parameters, value, workspace);
  if (!all_finite(value, M))
    return KEPLER_SCVI_2_NOT_FINITE;
  memcpy(p, value, sizeof(double) * M);
  return KEPLER_SCVI_2_OK;
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
      return KEPLER_SCVI_2_NOT_FINITE;
    if (misfit == 0.0)
      return KEPLER_SCVI_2_OK;
    if (!factorise(mass, M, pivot))
      return KEPLER_SCVI_2_SINGULAR;
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
      return misfit <= roundoff ? KEPLER_SCVI_2_OK : KEPLER_SCVI_2_NOT_CONVERGED;
    }
    misfit = nearer;
  }
  return KEPLER_SCVI_2_NOT_CONVERGED;
}

int kepler_scvi_2_velocity(double t, const double *q, const double *p, const double *parameters, double *v,
    double *workspace)
{
  int status = KEPLER_SCVI_2_SINGULAR;
  for (int attempt = 0; attempt < 3; attempt++) { /* from rest, from v = p, from v = 1 */
    double u[2 * M];
    for (int i = 0; i < M; i++) {
      u[i] = q[i];
      u[M + i] = attempt == 0 ? 0.0 : attempt == 1 ? p[i] : 1.0;
    }
    status = invert_momentum(t, u, p, parameters, workspace);
    if (status == KEPLER_SCVI_2_OK) {
      memcpy(v, u + M, sizeof(double) * M);
      return status;
    }
  }
  return status;
}

int kepler_scvi_2_energy(double t, const double *q, const double *p, const double *parameters, double *energy,
    double *workspace)
{
  double u[2 * M], value[1], sum;
  const int status = kepler_scvi_2_velocity(t, q, p, parameters, u + M, workspace);
  if (status != KEPLER_SCVI_2_OK)
    return status;
  memcpy(u, q, sizeof(double) * M);
  lagrangian(u, parameters, value);
  sum = -value[0];
  for (int i = 0; i < M; i++)
    sum += p[i] * u[M + i];
  if (!all_finite(&sum, 1))
    return KEPLER_SCVI_2_NOT_FINITE;
  *energy = sum;
  return KEPLER_SCVI_2_OK;
}

int kepler_scvi_2_energies(long long count, const double *t, const double *q, const double *p, const double *parameters,
    double *energy, double *workspace)
{
  for (long long k = 0; k < count; k++) {
    const int status = kepler_scvi_2_energy(t[k], q + k * M, p + k * M, parameters, energy + k, workspace);
    if (status != KEPLER_SCVI_2_OK)
      return status;
  }
  return KEPLER_SCVI_2_OK;
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
    double u[4], value[4];
    gather(QUADRATURE_GATHER_0[n], h, z, u + 0);
    offset(step, u + 0);
    gather(QUADRATURE_GATHER_1[n], 1.0, z, u + 2);
    if (jacobian) {
      double *slope = step->scratch;
      quadrature_slope(u, step->parameters, value, slope);
      scatter_slope(QUADRATURE_SCATTER_0[n], QUADRATURE_GATHER_0[n], QUADRATURE_WEIGHT[n] * h*h,
          QUADRATURE_SLOPE_0, 4, slope + 0, jacobian, stride);
      scatter_slope(QUADRATURE_SCATTER_1[n], QUADRATURE_GATHER_1[n], QUADRATURE_WEIGHT[n] * 1.0,
          QUADRATURE_SLOPE_1, 2, slope + 4, jacobian, stride);
    } else {
      quadrature_value(u, step->parameters, value);
    }
    scatter(QUADRATURE_SCATTER_0[n], QUADRATURE_WEIGHT[n] * h, value + 0, rows, size);
    scatter(QUADRATURE_SCATTER_1[n], QUADRATURE_WEIGHT[n] * 1.0, value + 2, rows, size);
  }
}

/* Node points: their part of the rows, and of the Jacobian unless it is NULL. */
static void add_node(const step_data *step, const double *z, double *rows, double *size, double *jacobian, int stride)
{
  const double h = step->h;
  for (int n = 0; n < 2; n++) {
    double u[8], value[8];
    gather(NODE_GATHER_0[n], h, z, u + 0);
    offset(step, u + 0);
    gather(NODE_GATHER_1[n], 1.0, z, u + 2);
    gather(NODE_GATHER_2[n], 1.0/(h), z, u + 4);
    gather(NODE_GATHER_3[n], 1.0, z, u + 6);
    if (jacobian) {
      double *slope = step->scratch;
      node_slope(u, step->parameters, value, slope);
      scatter_slope(NODE_SCATTER_0[n], NODE_GATHER_0[n], 1.0 * h*h*h,
          NODE_SLOPE_0, 4, slope + 0, jacobian, stride);
      scatter_slope(NODE_SCATTER_0[n], NODE_GATHER_3[n], 1.0 * h*h,
          NODE_SLOPE_1, 4, slope + 4, jacobian, stride);
      scatter_slope(NODE_SCATTER_2[n], NODE_GATHER_3[n], 1.0 * 1.0,
          NODE_SLOPE_2, 2, slope + 8, jacobian, stride);
      scatter_slope(NODE_SCATTER_3[n], NODE_GATHER_0[n], 1.0 * h*h,
          NODE_SLOPE_3, 4, slope + 10, jacobian, stride);
      scatter_slope(NODE_SCATTER_3[n], NODE_GATHER_2[n], 1.0 * 1.0,
          NODE_SLOPE_4, 2, slope + 14, jacobian, stride);
    } else {
      node_value(u, step->parameters, value);
    }
    scatter(NODE_SCATTER_0[n], 1.0 * h*h, value + 0, rows, size);
    scatter(NODE_SCATTER_1[n], 1.0 * h, value + 2, rows, size);
    scatter(NODE_SCATTER_2[n], 1.0 * 1.0, value + 4, rows, size);
    scatter(NODE_SCATTER_3[n], 1.0 * h, value + 6, rows, size);
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
  add_node(step, z, rows, size_p, jacobian, stride);
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
static int has_converged(const kepler_scvi_2_options *options, const movement *moved, double last)
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
    const kepler_scvi_2_options *options, kepler_scvi_2_report *report, double *workspace)
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
      return KEPLER_SCVI_2_NOT_FINITE;
    if (k > 0) {
      measure_momentum(&moved, increment, last_increment, size_p);
      report->change = options->absolute ? moved.absolute : moved.relative;
      if (has_converged(options, &moved, last))
        return KEPLER_SCVI_2_OK;
      last = moved.relative;
    }
    if (k >= options->max_iterations)
      return KEPLER_SCVI_2_NOT_CONVERGED;
    if (!keep && !factorise(jacobian, size, pivot))
      return KEPLER_SCVI_2_SINGULAR;
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

#if defined(__AVX512F__) && 2 % 8 == 0
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

static inline lanes lanes_sqrt(lanes x)
{
  lane_view view = {x};
  for (int j = 0; j < LANES; j++)
    view.lane[j] = sqrt(view.lane[j]);
  return view.all;
}

/* x^(-3/2). AVX-512 has the inverse root to 14 bits; with e = 1 - x y^2 the rest is the series of (1 - e)^(-3/2). */
static inline lanes lanes_inverse_root_3(lanes x)
{
#if defined(__AVX512F__) && 2 % 8 == 0
  const lanes y = lanes_estimate_inverse_root(x), square = y * y, e = 1.0 - x * square;
  const lanes power = square * y, first = 1.5 + 1.875 * e, then = 2.1875 + 2.4609375 * e;
  return power + (power * e) * (first + (e * e) * then);
#else
  const lanes inverse = 1.0 / x;
  return inverse * inverse * lanes_sqrt(x);
#endif
}

/* x^(-5/2). AVX-512 has the inverse root to 14 bits; with e = 1 - x y^2 the rest is the series of (1 - e)^(-5/2). */
static inline lanes lanes_inverse_root_5(lanes x)
{
#if defined(__AVX512F__) && 2 % 8 == 0
  const lanes y = lanes_estimate_inverse_root(x), square = y * y, e = 1.0 - x * square;
  const lanes power = square * square * y, first = 2.5 + 4.375 * e, then = 6.5625 + 9.0234375 * e;
  return power + (power * e) * (first + (e * e) * then);
#else
  const lanes inverse = 1.0 / x;
  return inverse * inverse * inverse * lanes_sqrt(x);
#endif
}

/* Column j of a table multiplies node j. Lanes beyond node 2 or the last point repeat it. */
static const lanes COLLOCATION[2] = {
  {0.75, 1.0},
  {-0.25, 0.0}
};
static const lanes NODE_END = {1.0, 0.0};
static const lanes NODE_MASK = {1.0, 1.0};
static const lanes POINT_POSITION[2] = {
  {0.37799153207185376, 0.9553418012614795},
  {-0.16666666666666666, -0.16666666666666666}
};
static const lanes POINT_VELOCITY[2] = {
  {1.5773502691896257, 0.4226497308103742},
  {-0.5773502691896257, 0.5773502691896257}
};

/* From the accelerations of the last step and of the one before to a guess of those of the next. */
static const lanes LAST_ALONE[2] = {
  {-1.0, -2.0},
  {2.0, 3.0}
};
static const lanes LAST[2] = {
  {-0.75, -2.15},
  {2.25, 4.05}
};
static const lanes BEFORE[2] = {
  {0.75, 1.95},
  {-1.25, -2.85}
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

/* E, (m . E)_q, (m . E)_v and the lower triangle of L_vv at all nodes, u = (q, v, a, m). Operations: 19 *, 3 +, 4 -, 1 inverse_root_3, 1 inverse_root_5. */
static inline void node_lanes(const lanes *u, const double *parameters, lanes *value, lanes *slope)
{
  const lanes w0 = u[0]*u[0];
  const lanes w1 = u[1]*u[1];
  const lanes w2 = w0 + w1;
  const lanes w3 = parameters[0]*lanes_inverse_root_3(w2);
  const lanes w4 = lanes_inverse_root_5(w2);
  const double w5 = 3.0*parameters[0];
  const lanes w6 = w5*w4*u[0]*u[1];
  value[0] = w3*u[0] + u[4];
  value[1] = w3*u[1] + u[5];
  value[2] = w3*u[6] - w5*w0*w4*u[6] - w6*u[7];
  value[3] = w3*u[7] - w5*w1*w4*u[7] - w6*u[6];
  value[4] = lanes_of(0.0);
  value[5] = lanes_of(0.0);
  slope[0] = lanes_of(1.0);
  slope[1] = lanes_of(1.0);
}

/* L_q and L_v at all points, u = (q, v). Operations: 5 *, 1 +, 1 inverse_root_3, 2 neg. */
static inline void action_lanes(const lanes *u, const double *parameters, lanes *value)
{
  const lanes w0 = parameters[0]*lanes_inverse_root_3(u[0]*u[0] + u[1]*u[1]);
  value[0] = -(w0*u[0]);
  value[1] = -(w0*u[1]);
  value[2] = u[2];
  value[3] = u[3];
}

/* The masses are diagonal: nothing to factorise. */
static inline void factor_mass(lanes *mass)
{
  (void)mass;
}

/* d = mass^-1 r in every lane. */
static inline void solve_mass(const lanes *mass, lanes *r)
{
  for (int i = 0; i < M; i++)
    r[i] /= mass[i];
}

/* What follows a sweep would change the points by, squared, with a margin: the rate of contraction is that from the sweep
 * before, whose change is infinite before the first. */
static inline double expected_change(double change, double last, int absolute)
{
  const double quotient = change / last, ratio = last < INFINITY ? smaller(larger(quotient, 1e-6), 0.25) : 1.0; /* squares */
  return absolute ? change : 16.0 * ratio * change;
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

/* v0, z = h a and m of the curve of a step. */
typedef struct {
  double v0[M];
  lanes z[M], m[M];
} curve_data;

/* In memory: z of the last step and of the one before, v0, m. */
static void save_curve(const curve_data *curve, double *memory)
{
  remember_curve(curve->z, memory);
  memcpy(memory + 2 * M * LANES, curve->v0, sizeof curve->v0);
  lanes_store(curve->m, memory + 2 * M * LANES + M);
}

/* v1 = v0 + sum b z. */
static inline double end_velocity(const curve_data *curve, int i)
{
  return curve->v0[i] + lanes_total(NODE_MASK * NODE_END * curve->z[i]);
}

/* The curve of the last steps continued, or a straight line. */
static int first_curve(const step_data *step, const double *memory, long long steps, curve_data *curve)
{
  int status = KEPLER_SCVI_2_OK;
  if (steps > 0) {
    lanes_load(memory, curve->z);
    memcpy(curve->v0, memory + 2 * M * LANES, sizeof curve->v0);
    for (int i = 0; i < M; i++)
      curve->v0[i] = end_velocity(curve, i);
    continue_curve(memory, steps, curve->z);
    lanes_load(memory + 2 * M * LANES + M, curve->m);
  } else {
    for (int i = 0; i < M; i++)
      curve->z[i] = curve->m[i] = lanes_of(0.0);
    status = kepler_scvi_2_velocity(step->t, step->q0, step->p0, step->parameters, curve->v0, step->scratch);
  }
  return status;
}

/* 1 / (|v0| + |v1|), which makes changes of velocities relative. */
static inline void measure_curve(const step_data *step, const curve_data *curve, int absolute, double *inverse_size)
{
  double largest = 0.0;
  for (int i = 0; i < M; i++) {
    inverse_size[i] = fabs(curve->v0[i]) + fabs(end_velocity(curve, i));
    largest = larger(largest, inverse_size[i]);
  }
  for (int i = 0; i < M; i++)
    inverse_size[i] = absolute ? fabs(step->h) : 1.0 / (inverse_size[i] + DBL_EPSILON * largest + DBL_MIN);
}

/* Positions, velocities, accelerations and multipliers at the nodes. */
static inline void place_nodes(const step_data *step, const curve_data *curve, lanes *u)
{
  for (int i = 0; i < M; i++) {
    u[M + i] = curve->v0[i] + lanes_apply(COLLOCATION, curve->z[i]);
    u[i] = step->q0[i] + (step->carry_q[i] + lanes_apply(COLLOCATION, step->h * u[M + i]));
    u[2 * M + i] = curve->z[i] / step->h;
    u[3 * M + i] = curve->m[i];
  }
}

/* Positions and velocities at the quadrature points. */
static inline void place_points(const step_data *step, const curve_data *curve, lanes *u)
{
  for (int i = 0; i < M; i++) {
    const lanes V = curve->v0[i] + lanes_apply(COLLOCATION, curve->z[i]);
    u[i] = step->q0[i] + (step->carry_q[i] + lanes_apply(POINT_POSITION, step->h * V));
    u[M + i] = lanes_apply(POINT_VELOCITY, V);
  }
}

/* v0 -= mass^-1 misfit, the mean over the nodes; how much it moved, relative and squared. */
static inline double correct_velocity(const lanes *mass, const double *misfit, const double *inverse_size, double *v0)
{
  lanes r[M];
  double total = 0.0;
  for (int i = 0; i < M; i++)
    r[i] = lanes_of(misfit[i]);
  solve_mass(mass, r);
  for (int i = 0; i < M; i++) {
    const double correction = lanes_total(NODE_MASK * r[i]) / 2.0, moved = correction * inverse_size[i];
    total += moved * moved;
    v0[i] -= correction;
  }
  return total;
}

/* q1 - q0. */
static inline void end_increment(const step_data *step, const curve_data *curve, double *dq)
{
  for (int i = 0; i < M; i++)
    dq[i] = lanes_total(NODE_MASK * NODE_END * (step->h * (curve->v0[i] + lanes_apply(COLLOCATION, curve->z[i]))));
}

/* What the points and nodes give back, and weights. */
static const lanes COLLOCATION_T[2] = {
  {0.75, -0.25},
  {1.0, 0.0}
};
static const lanes POINT_POSITION_T[2] = {
  {0.37799153207185376, -0.16666666666666666},
  {0.9553418012614795, -0.16666666666666666}
};
static const lanes POINT_VELOCITY_T[2] = {
  {1.5773502691896257, -0.5773502691896257},
  {0.4226497308103742, 0.5773502691896257}
};
static const lanes POINT_WEIGHT = {0.5, 0.5};
static const lanes NODE_CONSISTENCY = {1.0, 0.0};

typedef struct {
  lanes weight; /* h w */
} sweep_data;

static void prepare_sweep(const step_data *step, sweep_data *data)
{
  data->weight = step->h * POINT_WEIGHT;
}

/* p1 - p0 from the forces at the points and the gradient of m . E at the nodes. */
static inline double momentum_increment(const step_data *step, const sweep_data *data, lanes force, lanes slope)
{
  return lanes_total(data->weight * force) + step->h * (step->h * lanes_total(NODE_MASK * slope));
}

/* One step. Accelerations, momentum, initial velocity and multipliers are corrected in turn until all rest. */
static int sweep(const step_data *step, const sweep_data *data, double *memory, long long *steps, double *dq, double *dp,
    const kepler_scvi_2_options *options, kepler_scvi_2_report *report)
{
  curve_data curve;
  lanes u[4 * M], node[3 * M], action[2 * M], mass[M];
  const double h = step->h;
  double inverse_size[M], first = 0.0, last = INFINITY;
  int status, settled = 0;
  status = first_curve(step, memory, *steps, &curve);
  if (status != KEPLER_SCVI_2_OK)
    return status;
  for (int k = 0; status == 0; k++) {
    lanes change = lanes_of(0.0), r[M], gamma[M];
    double total, misfit[M];
    place_nodes(step, &curve, u);
    node_lanes(u, step->parameters, node, mass);
    factor_mass(mass);
    for (int i = 0; i < M; i++)
      r[i] = h * node[i];
    solve_mass(mass, r);
    for (int i = 0; i < M; i++)
      curve.z[i] -= r[i];
    if (k == 0)
      measure_curve(step, &curve, options->absolute, inverse_size);
    for (int i = 0; i < M; i++) {
      const lanes moved = r[i] * inverse_size[i];
      change += moved * moved;
    }
    place_points(step, &curve, u);
    action_lanes(u, step->parameters, action);
    for (int i = 0; i < M; i++) {
      const double p1 = step->p0[i] + (step->carry_p[i] + momentum_increment(step, data, action[i], node[M + i]));
      gamma[i] = lanes_apply(POINT_POSITION_T, data->weight * action[i]) + lanes_apply(POINT_VELOCITY_T, POINT_WEIGHT * action[M + i])
          + h * (node[2 * M + i] + h * lanes_apply(COLLOCATION_T, node[M + i])) - NODE_END * p1;
      misfit[i] = lanes_total(NODE_MASK * gamma[i]);
      r[i] = lanes_apply(COLLOCATION_T, gamma[i] - NODE_CONSISTENCY * misfit[i]);
    }
    total = correct_velocity(mass, misfit, inverse_size, curve.v0);
    solve_mass(mass, r);
    for (int i = 0; i < M; i++) {
      const lanes moved = (r[i] + curve.m[i]) * inverse_size[i];
      change += moved * moved;
      curve.m[i] = -r[i];
    }
    total += lanes_total(change);
    status = sweep_status(total, last, options->tolerance, options->absolute, options->max_iterations, k);
    if (status > 0 && !settled) { /* once more: the rate of contraction shows late */
      settled = 1;
      status = 0;
    }
    first = k == 0 ? total : first;
    last = total;
    report->iterations++;
  }
  report->change = sqrt(last);
  if (status < 0)
    return last < INFINITY ? KEPLER_SCVI_2_NOT_CONVERGED : KEPLER_SCVI_2_NOT_FINITE;
  place_nodes(step, &curve, u);
  node_lanes(u, step->parameters, node, mass);
  place_points(step, &curve, u);
  action_lanes(u, step->parameters, action);
  end_increment(step, &curve, dq);
  for (int i = 0; i < M; i++)
    dp[i] = momentum_increment(step, data, action[i], node[M + i]);
  if (!all_finite(dq, M) || !all_finite(dp, M))
    return KEPLER_SCVI_2_NOT_FINITE;
  save_curve(&curve, memory);
  *steps = steps_to_continue(*steps, first);
  return KEPLER_SCVI_2_OK;
}
#endif

kepler_scvi_2_options kepler_scvi_2_default_options(void)
{
  const kepler_scvi_2_options options = {2.220446049250313e-16, 50, 0};
  return options;
}

/* The guess that q moves on a straight line with its initial velocity. */
static int guess_straight(const step_data *step, double *z)
{
  double v[M];
  const int status = kepler_scvi_2_velocity(step->t, step->q0, step->p0, step->parameters, v, step->scratch);
  for (int b = 0; status == KEPLER_SCVI_2_OK && b < B; b++)
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
    const kepler_scvi_2_options *options, kepler_scvi_2_report *report, double *workspace)
{
  double *z = workspace;
  int status = KEPLER_SCVI_2_NOT_CONVERGED;
  if (guess) {
    guess_extrapolated(memory, z);
    status = newton(step, z, NULL, NULL, dp, options, report, z + N);
  }
  if (status != KEPLER_SCVI_2_OK) {
    status = guess_straight(step, z);
    if (status == KEPLER_SCVI_2_OK)
      status = newton(step, z, NULL, NULL, dp, options, report, z + N);
  }
  if (status == KEPLER_SCVI_2_OK) {
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
    const kepler_scvi_2_options *options, kepler_scvi_2_report *report, double *workspace)
{
  long long steps = *guess;
  int status = sweep(step, data, memory, &steps, dq, dp, options, report);
  if (status != KEPLER_SCVI_2_OK && steps > 0) {
    steps = 0;
    status = sweep(step, data, memory, &steps, dq, dp, options, report);
  }
  if (status != KEPLER_SCVI_2_OK) {
    steps = 0;
    status = solve_newton(step, workspace, 0, dq, dp, options, report, workspace + MEMORY);
  }
  if (status == KEPLER_SCVI_2_OK)
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
    const kepler_scvi_2_options *options, kepler_scvi_2_report *report, double *workspace)
{
  const int status = solve_newton(step, memory, *guess != 0, dq, dp, options, report, workspace + MEMORY);
  (void)data;
  if (status == KEPLER_SCVI_2_OK)
    *guess = 1;
  return status;
}
#endif

int kepler_scvi_2_step(double t, double h, const double *q0, const double *p0, const double *parameters,
    const kepler_scvi_2_options *options, double *q1, double *p1, kepler_scvi_2_report *report, double *workspace)
{
  const kepler_scvi_2_options standard = kepler_scvi_2_default_options();
  const double nothing[M] = {0.0};
  const step_data step = {t, h, q0, p0, nothing, nothing, parameters, workspace};
  kepler_scvi_2_report unread;
  solver_data data;
  double *memory = workspace + SCRATCH, dq[M], dp[M];
  long long guess = 0;
  int status;
  report = report ? report : &unread;
  memset(report, 0, sizeof *report);
  report->t = t;
  prepare(&step, &data);
  status = solve(&step, &data, memory, &guess, dq, dp, options ? options : &standard, report, memory + MEMORY);
  if (status != KEPLER_SCVI_2_OK)
    return status;
  report->steps = 1;
  for (int i = 0; i < M; i++) {
    q1[i] = q0[i] + dq[i];
    p1[i] = p0[i] + dp[i];
  }
  return KEPLER_SCVI_2_OK;
}

void kepler_scvi_2_start(kepler_scvi_2_run *run, double t, double h, const double *q, const double *p)
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

int kepler_scvi_2_advance(kepler_scvi_2_run *run, long long steps, long long every, const double *parameters,
    const kepler_scvi_2_options *options, double *t, double *q, double *p, int *iterations,
    kepler_scvi_2_report *report, double *workspace)
{
  const kepler_scvi_2_options standard = kepler_scvi_2_default_options();
  step_data step = {run->t0, run->h, run->q, run->p, run->carry_q, run->carry_p, parameters, workspace};
  kepler_scvi_2_report unread;
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
    if (status != KEPLER_SCVI_2_OK)
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
  return KEPLER_SCVI_2_OK;
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
    gather(QUADRATURE_GATHER_1[n], 1.0, z, u + 2);
    lagrangian(u, step->parameters, value);
    sum += QUADRATURE_WEIGHT[n] * value[0];
  }
  return h * sum;
}

int kepler_scvi_2_discrete_legendre(double t, double h, const double *q0, const double *q1, const double *parameters,
    const kepler_scvi_2_options *options, double *p0, double *p1, double *action, kepler_scvi_2_report *report,
    double *workspace)
{
  const kepler_scvi_2_options standard = kepler_scvi_2_default_options();
  const double carry_q[M] = {0.0};
  kepler_scvi_2_report unread;
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
  status = kepler_scvi_2_momentum(t, q0, v, parameters, start_p, workspace);
  if (status == KEPLER_SCVI_2_OK)
    status = newton(&step, z, q1, start_p, increment, options ? options : &standard, report, z + N);
  if (status != KEPLER_SCVI_2_OK)
    return status;
  for (int i = 0; i < M; i++) {
    p0[i] = start_p[i];
    p1[i] = start_p[i] + increment[i];
  }
  *action = action_sum(&step, z);
  return KEPLER_SCVI_2_OK;
}
