/* Jacobian of the adjoint of a flow for CasADi: exact second derivatives. Requires: casadi_flow.h, flow_second.h. */

static const casadi_int NO_INPUT_SHAPE[2 + 1 + 1] = {STEP_INPUTS, 1};
static const casadi_int HESSIAN_SHAPE[] = {STEP_INPUTS, STEP_INPUTS, 1};
static const casadi_int NO_JACOBIAN_SHAPE[2 + FLOW_STATE * FLOW_COLUMNS + 1] = {STEP_INPUTS, FLOW_STATE * FLOW_COLUMNS};
static const casadi_int TRANSPOSED_SHAPE[] = {STEP_INPUTS, FLOW_STATE * FLOW_COLUMNS, 1};

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
    status = hessian_rows(&way, 1, x, same, each, found, &report);
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
  (void)iw, (void)w, (void)mem;
  if (res[0] && !arg[2])
    memset(res[0], 0, sizeof(double) * STEP_INPUTS * STEP_INPUTS);
  if (res[0] && arg[2])
    status = external_hessian(arg[0], arg[2], res[0]);
  if (res[2] && status == OK)
    status = external_transposed(arg[0], res[2]);
  return status != OK;
}

casadi_int EXTERNAL(jac_adj1_, _n_in)(void)
{
  return 4;
}

casadi_int EXTERNAL(jac_adj1_, _n_out)(void)
{
  return 3;
}

const casadi_int *EXTERNAL(jac_adj1_, _sparsity_in)(casadi_int i)
{
  return i == 0 ? INPUT_SHAPE : i == 1 ? NO_STATES_SHAPE
      : i == 2                         ? STATES_SHAPE
      : i == 3                         ? NO_INPUT_SHAPE
                                       : NULL;
}

const casadi_int *EXTERNAL(jac_adj1_, _sparsity_out)(casadi_int i)
{
  return i == 0 ? HESSIAN_SHAPE : i == 1 ? NO_JACOBIAN_SHAPE
      : i == 2                           ? TRANSPOSED_SHAPE
                                         : NULL;
}
