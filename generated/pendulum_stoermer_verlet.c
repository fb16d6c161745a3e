/* planar pendulum: Stoermer-Verlet (Lobatto IIIA-IIIB pair of two stages); see pendulum_stoermer_verlet.h. */
#include "pendulum_stoermer_verlet.h"

#include <float.h>
#include <math.h>
#include <string.h>

enum {
  M = 1, /* coordinates */
  B = 2, /* blocks of M unknowns */
  N = B * M,
  MEMORY = 2, /* numbers kept from step to step */
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

/* q1 = q0 + h sum_b END_POSITION[b] z_b; row r holds MOMENTUM_ROW[r] p0; the straight-line guess of z_b is STRAIGHT[b] v0,
 * the guess from the step before sum_c EXTRAPOLATION[b][c] z_c. */
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
 * Gather tables have one column a block, scatter tables one column a row and a last one for p1. */
static const double QUADRATURE_WEIGHT[2] = {
  0.5, 0.5
};

static const double QUADRATURE_GATHER_0[2][2] = {
  {0.0, 0.0},
  {0.5, 0.5}
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

int pendulum_stoermer_verlet_momentum(double t, const double *q, const double *v, const double *parameters, double *p,
    double *workspace)
{
  double u[2 * M], value[M];
  memcpy(u, q, sizeof(double) * M);
  memcpy(u + M, v, sizeof(double) * M);
  momentum_and_mass(t, u, parameters, value, workspace);
  if (!all_finite(value, M))
    return PENDULUM_STOERMER_VERLET_NOT_FINITE;
  memcpy(p, value, sizeof(double) * M);
  return PENDULUM_STOERMER_VERLET_OK;
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
      return PENDULUM_STOERMER_VERLET_NOT_FINITE;
    if (misfit == 0.0)
      return PENDULUM_STOERMER_VERLET_OK;
    if (!factorise(mass, M, pivot))
      return PENDULUM_STOERMER_VERLET_SINGULAR;
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
      return misfit <= roundoff ? PENDULUM_STOERMER_VERLET_OK : PENDULUM_STOERMER_VERLET_NOT_CONVERGED;
    }
    misfit = nearer;
  }
  return PENDULUM_STOERMER_VERLET_NOT_CONVERGED;
}

int pendulum_stoermer_verlet_velocity(double t, const double *q, const double *p, const double *parameters, double *v,
    double *workspace)
{
  int status = PENDULUM_STOERMER_VERLET_SINGULAR;
  for (int attempt = 0; attempt < 3; attempt++) { /* from rest, from v = p, from v = 1 */
    double u[2 * M];
    for (int i = 0; i < M; i++) {
      u[i] = q[i];
      u[M + i] = attempt == 0 ? 0.0 : attempt == 1 ? p[i] : 1.0;
    }
    status = invert_momentum(t, u, p, parameters, workspace);
    if (status == PENDULUM_STOERMER_VERLET_OK) {
      memcpy(v, u + M, sizeof(double) * M);
      return status;
    }
  }
  return status;
}

int pendulum_stoermer_verlet_energy(double t, const double *q, const double *p, const double *parameters, double *energy,
    double *workspace)
{
  double u[2 * M], value[1], sum;
  const int status = pendulum_stoermer_verlet_velocity(t, q, p, parameters, u + M, workspace);
  if (status != PENDULUM_STOERMER_VERLET_OK)
    return status;
  memcpy(u, q, sizeof(double) * M);
  lagrangian(u, parameters, value);
  sum = -value[0];
  for (int i = 0; i < M; i++)
    sum += p[i] * u[M + i];
  if (!all_finite(&sum, 1))
    return PENDULUM_STOERMER_VERLET_NOT_FINITE;
  *energy = sum;
  return PENDULUM_STOERMER_VERLET_OK;
}

int pendulum_stoermer_verlet_energies(long long count, const double *t, const double *q, const double *p, const double *parameters,
    double *energy, double *workspace)
{
  for (long long k = 0; k < count; k++) {
    const int status = pendulum_stoermer_verlet_energy(t[k], q + k * M, p + k * M, parameters, energy + k, workspace);
    if (status != PENDULUM_STOERMER_VERLET_OK)
      return status;
  }
  return PENDULUM_STOERMER_VERLET_OK;
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
static int has_converged(const pendulum_stoermer_verlet_options *options, const movement *moved, double last)
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
    const pendulum_stoermer_verlet_options *options, pendulum_stoermer_verlet_report *report, double *workspace)
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
      return PENDULUM_STOERMER_VERLET_NOT_FINITE;
    if (k > 0) {
      measure_momentum(&moved, increment, last_increment, size_p);
      report->change = options->absolute ? moved.absolute : moved.relative;
      if (has_converged(options, &moved, last))
        return PENDULUM_STOERMER_VERLET_OK;
      last = moved.relative;
    }
    if (k >= options->max_iterations)
      return PENDULUM_STOERMER_VERLET_NOT_CONVERGED;
    if (!keep && !factorise(jacobian, size, pivot))
      return PENDULUM_STOERMER_VERLET_SINGULAR;
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

pendulum_stoermer_verlet_options pendulum_stoermer_verlet_default_options(void)
{
  const pendulum_stoermer_verlet_options options = {2.220446049250313e-16, 50, 0};
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
    const pendulum_stoermer_verlet_options *options, pendulum_stoermer_verlet_report *report, double *workspace)
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
    return PENDULUM_STOERMER_VERLET_NOT_FINITE;
  memcpy(memory, F, sizeof F);
  *guess = 1;
  return PENDULUM_STOERMER_VERLET_OK;
}

int pendulum_stoermer_verlet_step(double t, double h, const double *q0, const double *p0, const double *parameters,
    const pendulum_stoermer_verlet_options *options, double *q1, double *p1, pendulum_stoermer_verlet_report *report, double *workspace)
{
  const pendulum_stoermer_verlet_options standard = pendulum_stoermer_verlet_default_options();
  const double nothing[M] = {0.0};
  const step_data step = {t, h, q0, p0, nothing, nothing, parameters, workspace};
  pendulum_stoermer_verlet_report unread;
  solver_data data;
  double *memory = workspace + SCRATCH, dq[M], dp[M];
  long long guess = 0;
  int status;
  report = report ? report : &unread;
  memset(report, 0, sizeof *report);
  report->t = t;
  prepare(&step, &data);
  status = solve(&step, &data, memory, &guess, dq, dp, options ? options : &standard, report, memory + MEMORY);
  if (status != PENDULUM_STOERMER_VERLET_OK)
    return status;
  report->steps = 1;
  for (int i = 0; i < M; i++) {
    q1[i] = q0[i] + dq[i];
    p1[i] = p0[i] + dp[i];
  }
  return PENDULUM_STOERMER_VERLET_OK;
}

void pendulum_stoermer_verlet_start(pendulum_stoermer_verlet_run *run, double t, double h, const double *q, const double *p)
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

int pendulum_stoermer_verlet_advance(pendulum_stoermer_verlet_run *run, long long steps, long long every, const double *parameters,
    const pendulum_stoermer_verlet_options *options, double *t, double *q, double *p, int *iterations,
    pendulum_stoermer_verlet_report *report, double *workspace)
{
  const pendulum_stoermer_verlet_options standard = pendulum_stoermer_verlet_default_options();
  step_data step = {run->t0, run->h, run->q, run->p, run->carry_q, run->carry_p, parameters, workspace};
  pendulum_stoermer_verlet_report unread;
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
    if (status != PENDULUM_STOERMER_VERLET_OK)
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
  return PENDULUM_STOERMER_VERLET_OK;
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

int pendulum_stoermer_verlet_discrete_legendre(double t, double h, const double *q0, const double *q1, const double *parameters,
    const pendulum_stoermer_verlet_options *options, double *p0, double *p1, double *action, pendulum_stoermer_verlet_report *report,
    double *workspace)
{
  const pendulum_stoermer_verlet_options standard = pendulum_stoermer_verlet_default_options();
  const double carry_q[M] = {0.0};
  pendulum_stoermer_verlet_report unread;
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
  status = pendulum_stoermer_verlet_momentum(t, q0, v, parameters, start_p, workspace);
  if (status == PENDULUM_STOERMER_VERLET_OK)
    status = newton(&step, z, q1, start_p, increment, options ? options : &standard, report, z + N);
  if (status != PENDULUM_STOERMER_VERLET_OK)
    return status;
  for (int i = 0; i < M; i++) {
    p0[i] = start_p[i];
    p1[i] = start_p[i] + increment[i];
  }
  *action = action_sum(&step, z);
  return PENDULUM_STOERMER_VERLET_OK;
}
