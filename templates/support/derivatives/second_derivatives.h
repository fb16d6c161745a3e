#include "jvp_and_vjp.h"

/* Second derivatives of a step by forward-over-reverse differentiation: the tangent of the adjoint. The stage equations
 * times the adjoint multipliers are a function of the inputs and the unknowns; its Hessian times a tangent vector is
 * the source of the tangents of the multipliers, which are solved for with the same factors. Requires: kernels of
 * second derivatives, HESSIAN_ARGUMENTS, HESSIAN_VALUES. */

/* Memory for WIDTH tangent and adjoint vectors. Tangent vectors of the inputs (change) and of the unknowns (dz);
 * adjoint variables (input_adjoints), their tangents (adjoint_tangents), and the contributions of the nonlinear terms
 * with respect to inputs (by_given) and unknowns (by_dz); at the points of a stage group, arguments and results:
 * tangents, adjoint variables, and tangents of these. Last, the arguments u. */
typedef struct {
  wide change[STEP_INPUTS], input_adjoints[STEP_INPUTS], adjoint_tangents[STEP_INPUTS], by_given[STEP_INPUTS];
  wide dz[N], by_dz[N], tangents[MOST_AT_POINTS], adjoints[MOST_AT_POINTS], tangents_of_adjoints[MOST_AT_POINTS];
  real u[];
} second_order_memory;

/* sum += factor x y, lane by lane. */
static inline void add_product(wide *sum, real factor, const wide *x, const wide *y)
{
  for (int j = 0; j < WIDTH; j++)
    sum->lane[j] += factor * x->lane[j] * y->lane[j];
}

/* Second derivatives of the kernel at a point for lane j: tangents of the adjoint variables of arguments, and of
 * parameters and time. */
static void add_kernel_hessian(const stage_group *f, const step_data *step, second_order_memory *to, int n, int j)
{
  const int arguments = f->arguments, results = f->results, parameters = STEP_INPUTS - 2 * M - 2;
  const wide *tangents = to->tangents + n * arguments, *adjoints = to->adjoints + f->points * arguments + n * results;
  const real c = f->abscissa ? f->abscissa[n] : 0;
  real u[HESSIAN_ARGUMENTS], value[HESSIAN_VALUES], *next = u;
  for (int i = 0; i < arguments; i++)
    *next++ = to->u[n * arguments + i];
  for (int i = 0; i < results; i++)
    *next++ = adjoints[i].lane[j];
  for (int i = 0; i < arguments; i++)
    *next++ = tangents[i].lane[j];
  for (int i = 0; i < parameters; i++)
    *next++ = to->change[2 * M + i].lane[j];
  *next = to->change[INPUT_H - 1].lane[j] + c * to->change[INPUT_H].lane[j];
  f->curvature(u, time_of(f, step, n), step->parameters, value);
  for (int i = 0; i < arguments; i++)
    to->tangents_of_adjoints[n * arguments + i].lane[j] += value[i];
  for (int i = 0; i <= parameters; i++)
    to->by_given[2 * M + i].lane[j] += value[arguments + i];
  to->by_given[INPUT_H].lane[j] += c * value[arguments + parameters];
}

/* Contributions of the factor h^power of the results to the tangents of the adjoint variables of the results and of
 * h. */
static void add_result_hessian(const stage_group *f, real h, second_order_memory *to, const real *by_h)
{
  const int first = f->points * f->arguments;
  for (int s = 0; s < f->scatters; s++) {
    const real power = (real)f->scatter[s].power;
    for (int n = 0; n < f->points; n++)
      for (int i = 0; i < f->scatter[s].sites; i++) {
        const int k = n * f->results + f->scatter[s].offset + i;
        const wide *dh = to->change + INPUT_H, *adjoints = to->adjoints + first + k;
        add_product(to->tangents_of_adjoints + first + k, power / h, adjoints, dh);
        add_product(to->by_given + INPUT_H, power / h, adjoints, to->tangents + first + k);
        add_product(to->by_given + INPUT_H, -(power + 1) * by_h[k] / h, adjoints, dh);
      }
  }
}

/* Contributions of arguments, q0 plus h^power times unknowns, to the tangents of the adjoint variables of h and of the
 * arguments. */
static void add_argument_hessian(const stage_group *f, real h, second_order_memory *to, const real *by_h)
{
  const wide *dh = to->change + INPUT_H;
  wide *by = to->by_given + INPUT_H;
  for (int g = 0; g < f->gathers; g++) {
    const linear_loop *loop = f->gather + g;
    const real power = (real)loop->power;
    for (int n = 0; n < f->points; n++)
      for (int i = 0; i < loop->sites; i++) {
        const int k = n * f->arguments + loop->offset + i;
        add_product(by, power / h, to->adjoints + k, to->tangents + k);
        if (loop->from_state)
          add_product(by, -power / h, to->adjoints + k, to->change + i);
        add_product(by, -by_h[k] / h, to->adjoints + k, dh);
        add_product(to->tangents_of_adjoints + k, power / h, to->adjoints + k, dh);
      }
  }
}

/* Contributions of a stage group. Returns the end of its derivatives. */
static const real *add_group_hessian(const stage_group *f, const linearised_step *at, second_order_memory *to,
    const real *partials)
{
  const real h = at->step->h, *by_h = partials + f->points * f->arguments, *derivative = by_h + f->points * f->results;
  const real *by_inputs = derivative + f->points * f->partials;
  const int first = f->points * f->arguments;
  memset(to->tangents, 0, sizeof to->tangents);
  memset(to->adjoints, 0, sizeof to->adjoints);
  memset(to->tangents_of_adjoints, 0, sizeof to->tangents_of_adjoints);
  arguments_wide(f, h, 0, partials, to->change, to->dz, to->tangents);
  multiply_wide(f, 0, derivative, to->tangents, to->tangents + first);
  inputs_wide(f, 0, by_h, by_inputs, to->change, to->tangents + first);
  scatter_wide(f, h, at->growth, 1, 0, to->adjoints + first, at->rows);
  multiply_wide(f, 1, derivative, to->adjoints, to->adjoints + first);
  if (f->curvature)
    arguments_of(f, at->step, at->data->z, to->u);
  for (int n = 0; f->curvature && n < f->points; n++)
    for (int j = 0; j < WIDTH; j++)
      add_kernel_hessian(f, at->step, to, n, j);
  add_result_hessian(f, h, to, by_h);
  multiply_wide(f, 1, derivative, to->tangents_of_adjoints, to->tangents_of_adjoints + first);
  inputs_wide(f, 1, by_h, by_inputs, to->by_given, to->tangents_of_adjoints + first);
  start_wide(f, 1, partials, to->by_given, to->tangents_of_adjoints);
  add_argument_hessian(f, h, to, partials);
  gather_wide(f, h, 1, to->by_dz, to->tangents_of_adjoints);
  return by_inputs + f->points * f->given;
}

/* Contributions of q1 = q0 + h (sum of unknowns). */
static void add_end_hessian(second_order_memory *to)
{
  for (int i = 0; i < M; i++)
    for (int b = 0; b < B; b++) {
      add_product(to->by_dz + i * B + b, END_POSITION[b], to->input_adjoints + i, to->change + INPUT_H);
      add_product(to->by_given + INPUT_H, END_POSITION[b], to->input_adjoints + i, to->dz + i * B + b);
    }
}

/* Replaces input_adjoints and adjoint_tangents, of (q1, p1, parameters, t + h, h), by those of (q0, p0, parameters, t,
 * h). */
static void hessian_of_step(const linearised_step *at, second_order_memory *to)
{
  const real *partials = at->partials;
  memcpy(at->v, to->change, sizeof(wide) * STEP_INPUTS);
  jvp_step(at);
  memcpy(to->dz, at->dz, sizeof(wide) * N);
  memcpy(at->v, to->input_adjoints, sizeof(wide) * STEP_INPUTS);
  vjp_step(at);
  memset(to->by_given, 0, sizeof(wide) * STEP_INPUTS);
  memset(to->by_dz, 0, sizeof(wide) * N);
  for (int f = 0; f < COUNT_OF_GROUPS; f++)
    partials = add_group_hessian(STAGE_GROUPS + f, at, to, partials);
  add_end_hessian(to);
  memcpy(to->input_adjoints, at->v, sizeof(wide) * STEP_INPUTS);
  memcpy(at->v, to->adjoint_tangents, sizeof(wide) * STEP_INPUTS);
  memcpy(at->dz, to->by_dz, sizeof(wide) * N);
  vjp_with_unknowns(at);
  for (int i = 0; i < STEP_INPUTS; i++)
    propagate(0, at->v + i, 1, to->by_given + i);
  memcpy(to->adjoint_tangents, at->v, sizeof(wide) * STEP_INPUTS);
}

/* Adds to (2, count, STEP_INPUTS) adjoint vectors and their tangents `to` the result of the step for `from`, WIDTH at a
 * time. */
static int hessian_of_vectors(const linearised_step *at, int count, const real *changes, const real *from, real *to)
{
  second_order_memory *of = (second_order_memory *)(at->points + MOST_AT_POINTS);
  for (int first = 0; first < count; first += WIDTH) {
    const int own = least(WIDTH, count - first), here = first * STEP_INPUTS, beside = (count + first) * STEP_INPUTS;
    read_lanes(of->change, own, changes + here);
    read_lanes(of->input_adjoints, own, from + here);
    read_lanes(of->adjoint_tangents, own, from + beside);
    hessian_of_step(at, of);
    add_lanes(of->input_adjoints, own, to + here);
    add_lanes(of->adjoint_tangents, own, to + beside);
  }
  return all_finite(to, 2 * count * STEP_INPUTS) ? OK : NOT_FINITE;
}

int NAME(second_order)(long long steps, const real *t, const real *h, const real *q, const real *p,
    const real *parameters, const solver_options *options, int count, const real *changes, real *vectors,
    solver_report *report, real *workspace)
{
  const real carry[M] = {0};
  const long long across = (long long)count * STEP_INPUTS;
  memset(report, 0, sizeof *report);
  for (long long k = steps - 1; k >= 0; k--) {
    const step_data step = step_from(t[k], h[k], q + k * M, p + k * M, carry, carry, parameters, workspace);
    linearised_step at = linearised_in(&step, workspace);
    report->t = t[k];
    TRY(linearise_step(&at, options ? options : &STANDARD_OPTIONS, NULL, NULL, report));
    TRY(hessian_of_vectors(
        &at, count, changes + k * across, vectors + (k + 1) * 2 * across, vectors + k * 2 * across));
    report->steps++;
  }
  return OK;
}
