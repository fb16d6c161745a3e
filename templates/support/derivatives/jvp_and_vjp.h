#include "../newton/newton_from_line.h"
#include "../newton/newton.h"
#include "linear_maps.h"
#ifdef FIRST_ORDER_SYSTEM
#include "momenta_of_variables.h"
#endif

/* Tangent and adjoint vectors over a step solved by Newton's method. The step is a function of its inputs x and the
 * unknowns z, which satisfy R(z, x) = 0: dz = -R_z^-1 R_x dx forward (JVP), and with the transposed matrices backward
 * (VJP; Griewank & Walther, Evaluating Derivatives, ch. 15). TIME_TRANSFORMATION: time depends on the state. */

enum {
  COUNT_OF_GROUPS = sizeof STAGE_GROUPS / sizeof *STAGE_GROUPS
};

/* The solved step, its derivatives at the points, and memory for tangent or adjoint vectors. */
typedef struct {
  const step_data *step;
  newton_data *data;
  band shape;
  real *partials;
  wide *v, *dz, *rows, *x, *points;
  wide *grown; /* variations of gamma h; NULL without damping */
  real growth; /* gamma h */
  real p1[M];
#ifdef FIRST_ORDER_SYSTEM
  step_data with_momenta;
  momentum_factors *momenta;
#endif
} linearised_step;

#ifdef TIME_TRANSFORMATION
/* Linearised time of a time-transformed system: time is an integral along the curve, by the weights of the first
 * points. Requires: INTEGRAL_WEIGHT, RATE_ENTRY, RATE_DERIVATIVES, the kernels rate_derivatives and
 * energy_derivatives. */

/* Derivative of the time at the end with respect to that at the start, q0, parameters, h and the unknowns; back: its
 * transpose. */
static void end_time(const linearised_step *at, int back)
{
  const step_data *step = at->step;
  const stage_group *f = STAGE_GROUPS;
  wide *time = at->v + INPUT_H - 1, *u = at->points;
  real *place = step->scratch;
  memset(u, 0, sizeof(wide) * (size_t)(f->points * f->arguments));
  if (!back)
    arguments_wide(f, step->h, back, at->partials, at->v, at->dz, u);
  arguments_of(f, step, at->data->z, place);
  for (int n = 0; n < f->points; n++) {
    const real weight = INTEGRAL_WEIGHT[n];
    real rate, derivative[RATE_DERIVATIVES];
    rate_derivatives(place + n * f->arguments, step->t, step->parameters, &rate, derivative);
    for (int e = 0; e < RATE_DERIVATIVES; e++) {
      const int j = RATE_ENTRY[e];
      propagate(back, time, step->h * weight * derivative[e],
          j < f->arguments ? u + n * f->arguments + j : at->v + 2 * M + j - f->arguments);
    }
    propagate(back, time, weight * rate, at->v + INPUT_H);
  }
  if (back)
    arguments_wide(f, step->h, back, at->partials, at->v, at->dz, u);
}

int NAME(energy_gradient)(const real *q, const real *p, const real *parameters, real *partials, real *workspace)
{
  real u[2 * M];
  memcpy(u, q, sizeof(real) * M);
#ifdef FROM_MOMENTA
  memcpy(u + M, p, sizeof(real) * M);
#else
  TRY(NAME(velocity)(0, q, p, parameters, u + M, workspace));
#endif
  energy_derivatives(u, 0, parameters, partials);
  return all_finite(partials, STEP_INPUTS - 2) ? OK : NOT_FINITE;
}
#else
/* Linearised time without time transformation: t + h. */

/* Derivative of the time at the end with respect to that at the start and h; back: its transpose. */
static void end_time(const linearised_step *at, int back)
{
  propagate(back, at->v + INPUT_H - 1, 1, at->v + INPUT_H);
}
#endif

/* Derivative of a step (JVP) and its transpose (VJP) by implicit differentiation of the stage equations. Requires:
 * STAGE_GROUPS, the stage groups; if DAMPED, growth_wide, from inputs to gamma h; end_time, the derivative of the time
 * at the end. */

static linearised_step linearised_in(const step_data *step, real *workspace)
{
  linearised_step at;
  at.step = step;
  at.data = newton_in(workspace + SCRATCH);
  at.shape = band_of(SITES, B);
  at.partials = workspace + WORKSPACE;
  at.v = (wide *)(at.partials + DERIVATIVES);
  at.dz = at.v + STEP_INPUTS;
  at.rows = at.dz + N;
  at.x = at.rows + SITES * (B + 1);
  at.points = at.x + SITES * (B + 1);
#ifdef DAMPED
  at.growth = growth_of(step);
  at.grown = at.points + MOST_AT_POINTS;
#else
  at.growth = 0;
  at.grown = NULL;
#endif
#ifdef FIRST_ORDER_SYSTEM
  at.momenta = (momentum_factors *)((real *)at.v - MOMENTUM_NUMBERS);
#endif
  return at;
}

/* Solves the step as the fallback does, factorises its equations and evaluates the derivatives at the points. */
static int linearise_step(linearised_step *at, const solver_options *options, real *q1, real *p1, solver_report *report)
{
#ifdef FIRST_ORDER_SYSTEM
  const int known = transform(at->step->t, at->step->q0, at->step->p0, at->step->parameters, at->momenta->theta,
      at->step->scratch);
  const step_data *step = &at->with_momenta;
  at->with_momenta = *at->step;
  at->with_momenta.theta0 = at->momenta->theta;
  at->step = step;
  if (known != OK)
    return known;
#else
  const step_data *step = at->step;
#endif
  const long long before = report->iterations;
  real dq[M], dp[2 * M] = {0}, size_p[SITES], size_q[M], *partials = at->partials;
  int keep = 0;
  TRY(newton_from_line(step, at->data, dp, &keep, options, report));
  gather(END_POSITION, 1, step->h, at->data->z, M, dq, 0, 1);
  if (is_spurious(step, at->data->z, dq, report->iterations - before))
    return STATUS(SPURIOUS_SOLUTION);
  evaluate(step, at->data->z, at->data->rows, size_p, size_q, at->data->factors, &at->shape);
  TRY(factorise(at->data->factors, &at->shape, at->data->pivot) ? OK : SINGULAR);
  for (int f = 0; f < COUNT_OF_GROUPS; f++)
    partials = derivatives_of_group(STAGE_GROUPS + f, step, at->data->z, partials);
#ifdef FIRST_ORDER_SYSTEM
  TRY(variables_of_momenta(step, at->data->z, dq, dp));
#endif
  for (int i = 0; i < M; i++) {
    dq[i] = step->q0[i] + dq[i];
    at->p1[i] = step->p0[i] + (dp[i] + dp[M + i]);
  }
#ifdef FIRST_ORDER_SYSTEM
  TRY(linearise_momenta(step, dq, at->p1, at->momenta));
#endif
  for (int i = 0; q1 && i < M; i++) {
    q1[i] = dq[i];
    p1[i] = at->p1[i];
  }
  return OK;
}

/* From v (back: to it) to all rows, or from dz to the last one, that of p1, through all points. */
static void through_points(const linearised_step *at, int back, wide *v, wide *dz)
{
  const step_change by = {.h = at->step->h, .growth = at->growth, .grown = at->grown};
  const real *partials = at->partials;
  for (int f = 0; f < COUNT_OF_GROUPS; f++)
    partials = through_group(STAGE_GROUPS + f, &by, back, partials, at->points, v, dz, at->rows);
}

/* dz = -(matrix)^-1 rows, without the last row of each site. */
static void solve_forward(const linearised_step *at)
{
  for (int i = 0; i < N; i++)
    at->x[POSITION_IN_MATRIX[i / B] * B + i % B] = at->rows[i / B * (B + 1) + i % B];
  solve_wide(at->data->factors, &at->shape, at->data->pivot, 0, at->x);
  memset(at->dz, 0, sizeof(wide) * N);
  for (int i = 0; i < N; i++)
    propagate(0, at->dz + i, -1, at->x + POSITION_IN_MATRIX[i / B] * B + i % B);
}

/* rows = -(transposed matrix)^-1 dz. */
static void solve_back(const linearised_step *at)
{
  memset(at->x, 0, sizeof(wide) * N);
  for (int i = 0; i < N; i++)
    propagate(1, at->dz + i, -1, at->x + POSITION_IN_MATRIX[i / B] * B + i % B);
  solve_wide(at->data->factors, &at->shape, at->data->pivot, 1, at->x);
  for (int i = 0; i < N; i++)
    at->rows[i / B * (B + 1) + i % B] = at->x[POSITION_IN_MATRIX[i / B] * B + i % B];
}

/* Derivative of q1 with respect to q0, unknowns and h. */
static void end_position(const linearised_step *at, int back)
{
  const real h = at->step->h, *z = at->data->z;
  for (int i = 0; i < M; i++)
    for (int b = 0; b < B; b++) {
      propagate(back, at->v + i, h * END_POSITION[b], at->dz + i * B + b);
      propagate(back, at->v + i, END_POSITION[b] * z[i * B + b], at->v + INPUT_H);
    }
}

/* Derivative of the rows with respect to p0. */
static void momentum_rows(const linearised_step *at, int back)
{
  for (int i = 0; i < M; i++)
    for (int r = 0; r < B; r++)
      propagate(back, at->rows + i * (B + 1) + r, MOMENTUM_ROW[r], at->v + M + i);
}

/* Derivative of p1 with respect to p0, the rows of its increment, and damping. */
static void end_momentum(const linearised_step *at, int back)
{
#ifdef DAMPED
  const real factor = MATH(exp)(-at->growth);
#endif
  for (int i = 0; i < M; i++) {
    wide *p = at->v + M + i;
    if (!back)
      propagate(0, p, 1, at->rows + i * (B + 1) + B);
#ifdef DAMPED
    if (back)
      propagate(1, p, -at->p1[i], at->grown);
    for (int j = 0; j < WIDTH; j++)
      p->lane[j] *= factor;
    if (!back)
      propagate(0, p, -at->p1[i], at->grown);
#endif
    if (back)
      propagate(1, p, 1, at->rows + i * (B + 1) + B);
  }
}

/* Replaces v, variations of (q0, p0, parameters, t, h), by those of (q1, p1, parameters, t + h, h) (JVP). */
static void jvp_step(const linearised_step *at)
{
  memset(at->rows, 0, sizeof(wide) * SITES * (B + 1));
#ifdef DAMPED
  memset(at->grown, 0, sizeof(wide));
  growth_wide(at->step, 0, at->v, at->grown);
#endif
#ifdef FIRST_ORDER_SYSTEM
  momenta_wide(at->momenta, 0, at->v);
#endif
  momentum_rows(at, 0);
  through_points(at, 0, at->v, NULL);
  solve_forward(at);
  through_points(at, 0, NULL, at->dz);
  end_time(at, 0);
  end_position(at, 0);
  end_momentum(at, 0);
#ifdef FIRST_ORDER_SYSTEM
  variables_wide(at->momenta, 0, at->v);
#endif
}

/* Replaces v, adjoint variables of (q1, p1, parameters, t + h, h), by those of (q0, p0, parameters, t, h) (VJP). dz
 * contains the adjoint variables of the unknowns. */
static void vjp_with_unknowns(const linearised_step *at)
{
  memset(at->rows, 0, sizeof(wide) * SITES * (B + 1));
#ifdef DAMPED
  memset(at->grown, 0, sizeof(wide));
#endif
#ifdef FIRST_ORDER_SYSTEM
  variables_wide(at->momenta, 1, at->v);
#endif
  end_momentum(at, 1);
  end_position(at, 1);
  end_time(at, 1);
  through_points(at, 1, NULL, at->dz);
  solve_back(at);
  through_points(at, 1, at->v, NULL);
  momentum_rows(at, 1);
#ifdef FIRST_ORDER_SYSTEM
  momenta_wide(at->momenta, 1, at->v);
#endif
#ifdef DAMPED
  growth_wide(at->step, 1, at->v, at->grown);
#endif
}

static void vjp_step(const linearised_step *at)
{
  memset(at->dz, 0, sizeof(wide) * N);
  vjp_with_unknowns(at);
}

static void read_lanes(wide *to, int own, const real *from)
{
  memset(to, 0, sizeof(wide) * STEP_INPUTS);
  for (int j = 0; j < own; j++)
    for (int i = 0; i < STEP_INPUTS; i++)
      to[i].lane[j] = from[j * STEP_INPUTS + i];
}

static void add_lanes(const wide *from, int own, real *to)
{
  for (int j = 0; j < own; j++)
    for (int i = 0; i < STEP_INPUTS; i++)
      to[j * STEP_INPUTS + i] += from[i].lane[j];
}

/* Adds to the vectors `to` the JVPs (back: VJPs) of `from`, WIDTH at a time. */
static int propagate_vectors(const linearised_step *at, int back, int count, const real *from, real *to)
{
  for (int first = 0; first < count; first += WIDTH) {
    const int own = least(WIDTH, count - first);
    read_lanes(at->v, own, from + first * STEP_INPUTS);
    (back ? vjp_step : jvp_step)(at);
    add_lanes(at->v, own, to + first * STEP_INPUTS);
  }
  return all_finite(to, count * STEP_INPUTS) ? OK : NOT_FINITE;
}
