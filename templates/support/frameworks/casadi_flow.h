#include "flow.h"

/* Flow of FLOW_STEPS steps with a state stored every FLOW_EVERY steps, and its derivatives, under the names by which
 * CasADi finds external functions. Requires: EXTERNAL, which forms these names. */

typedef long long casadi_int;

enum {
  FLOW_COLUMNS = FLOW_STEPS / FLOW_EVERY + 1
};

/* Sparsity patterns: dense (rows, columns, 1), or empty for arguments that a derivative does not depend on. */
static const casadi_int INPUT_SHAPE[] = {STEP_INPUTS, 1, 1};
static const casadi_int STATES_SHAPE[] = {FLOW_STATE, FLOW_COLUMNS, 1};
static const casadi_int JACOBIAN_SHAPE[] = {FLOW_STATE * FLOW_COLUMNS, STEP_INPUTS, 1};
static const casadi_int NO_STATES_SHAPE[2 + FLOW_COLUMNS + 1] = {FLOW_STATE, FLOW_COLUMNS};

/* Defines the numbers and sparsity patterns of the arguments and results of a function. */
#define DESCRIBE(function, ARGUMENTS, RESULTS)                      \
  casadi_int EXTERNAL(function, _n_in)(void)                        \
  {                                                                 \
    return sizeof ARGUMENTS / sizeof *ARGUMENTS;                    \
  }                                                                 \
  casadi_int EXTERNAL(function, _n_out)(void)                       \
  {                                                                 \
    return sizeof RESULTS / sizeof *RESULTS;                        \
  }                                                                 \
  const casadi_int *EXTERNAL(function, _sparsity_in)(casadi_int i)  \
  {                                                                 \
    return i < EXTERNAL(function, _n_in)() ? ARGUMENTS[i] : NULL;   \
  }                                                                 \
  const casadi_int *EXTERNAL(function, _sparsity_out)(casadi_int i) \
  {                                                                 \
    return i < EXTERNAL(function, _n_out)() ? RESULTS[i] : NULL;    \
  }

static const casadi_int *const FLOW_ARGUMENTS[] = {INPUT_SHAPE}, *const FLOW_RESULTS[] = {STATES_SHAPE};
DESCRIBE(, FLOW_ARGUMENTS, FLOW_RESULTS)
static const casadi_int *const JACOBIAN_ARGUMENTS[] = {INPUT_SHAPE, NO_STATES_SHAPE};
static const casadi_int *const JACOBIAN_RESULTS[] = {JACOBIAN_SHAPE};
DESCRIBE(jac_, JACOBIAN_ARGUMENTS, JACOBIAN_RESULTS)
static const casadi_int *const ADJOINT_ARGUMENTS[] = {INPUT_SHAPE, NO_STATES_SHAPE, STATES_SHAPE};
DESCRIBE(adj1_, ADJOINT_ARGUMENTS, FLOW_ARGUMENTS)

/* Calls the flow. A NULL result is not computed; a NULL argument counts as 0. */
static int external_flow(flow_part part, int count, const double *x, const double *given, double *found)
{
  flow_call way = {.steps = FLOW_STEPS, .every = FLOW_EVERY, .count = count};
  solver_report report;
  return found && flow_rows(part, &way, 1, x, given, NULL, found, &report) != OK;
}

int EXTERNAL(, )(const double **arg, double **res, casadi_int *iw, double *w, int mem)
{
  return external_flow(FLOW_STATES, 0, arg[0], NULL, res[0]);
}

/* Jacobian, by columns: the JVPs of the unit vectors. */
int EXTERNAL(jac_, )(const double **arg, double **res, casadi_int *iw, double *w, int mem)
{
  double each[STEP_INPUTS * STEP_INPUTS] = {0};
  for (int i = 0; i < STEP_INPUTS; i++)
    each[i * STEP_INPUTS + i] = 1;
  return external_flow(FLOW_JVP, STEP_INPUTS, arg[0], each, res[0]);
}

/* Gradient with respect to the inputs from the adjoint variables of the states (VJP). */
int EXTERNAL(adj1_, )(const double **arg, double **res, casadi_int *iw, double *w, int mem)
{
  if (!arg[2] && res[0])
    memset(res[0], 0, sizeof(double) * STEP_INPUTS);
  return arg[2] && external_flow(FLOW_VJP, 1, arg[0], arg[2], res[0]);
}

#ifdef SECOND_DERIVATIVES
/* Jacobian of the adjoint of a flow for CasADi: exact second derivatives. */

static const casadi_int NO_INPUT_SHAPE[2 + 1 + 1] = {STEP_INPUTS, 1};
static const casadi_int HESSIAN_SHAPE[] = {STEP_INPUTS, STEP_INPUTS, 1};
static const casadi_int NO_JACOBIAN_SHAPE[2 + FLOW_STATE * FLOW_COLUMNS + 1] = {STEP_INPUTS, FLOW_STATE * FLOW_COLUMNS};
static const casadi_int TRANSPOSED_SHAPE[] = {STEP_INPUTS, FLOW_STATE * FLOW_COLUMNS, 1};
static const casadi_int *const SECOND_ARGUMENTS[] = {INPUT_SHAPE, NO_STATES_SHAPE, STATES_SHAPE, NO_INPUT_SHAPE};
static const casadi_int *const SECOND_RESULTS[] = {HESSIAN_SHAPE, NO_JACOBIAN_SHAPE, TRANSPOSED_SHAPE};
DESCRIBE(jac_adj1_, SECOND_ARGUMENTS, SECOND_RESULTS)

/* Derivatives of the adjoint with respect to the inputs (Hessian-vector products of the unit vectors), by columns. */
static int external_hessian(const double *x, const double *partials, double *found)
{
  enum { VALUES = FLOW_STATE * FLOW_COLUMNS };
  flow_call way = {.steps = FLOW_STEPS, .every = FLOW_EVERY, .count = STEP_INPUTS};
  double each[STEP_INPUTS * STEP_INPUTS] = {0}, *same = malloc(sizeof(double) * (size_t)VALUES * STEP_INPUTS);
  solver_report report;
  int status = FLOW_NO_MEMORY;
  for (int i = 0; same && i < STEP_INPUTS; i++) {
    each[i * STEP_INPUTS + i] = 1;
    memcpy(same + i * VALUES, partials, sizeof(double) * VALUES);
  }
  if (same)
    status = flow_rows(FLOW_HESSIAN, &way, 1, x, same, each, found, &report);
  free(same);
  return status;
}

/* Transposed Jacobian, by columns: the VJPs of the unit vectors. */
static int external_transposed(const double *x, double *found)
{
  enum { VALUES = FLOW_STATE * FLOW_COLUMNS };
  double *each = calloc((size_t)VALUES * VALUES, sizeof(double));
  int status = FLOW_NO_MEMORY;
  for (int i = 0; each && i < VALUES; i++)
    each[i * VALUES + i] = 1;
  if (each)
    status = external_flow(FLOW_VJP, VALUES, x, each, found);
  free(each);
  return status;
}

int EXTERNAL(jac_adj1_, )(const double **arg, double **res, casadi_int *iw, double *w, int mem)
{
  int status = OK;
  if (res[0] && !arg[2])
    memset(res[0], 0, sizeof(double) * STEP_INPUTS * STEP_INPUTS);
  if (res[0] && arg[2])
    status = external_hessian(arg[0], arg[2], res[0]);
  if (res[2] && status == OK)
    status = external_transposed(arg[0], res[2]);
  return status != OK;
}

#endif
