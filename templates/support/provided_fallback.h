/* Newton solver for a library without it (see fallback.h). Requires: newton_fallback.h, FALLBACK_WORKSPACE. */
#include <stdlib.h>

static SELDOM int provided_step(const step_data *step, double *dq, double *dp, const solver_options *options,
    solver_report *report, double *error)
{
  double *workspace = malloc(sizeof(double) * STATUS(FALLBACK_WORKSPACE));
  step_data own = *step;
  int status;
  if (workspace == NULL)
    return STATUS(FALLBACK_REQUIRED);
  own.scratch = workspace;
  own.first = 1;
  own.tables = NULL;
  status = fall_back(NOT_CONVERGED, &own, dq, dp, options, report, workspace + SCRATCH);
  *error = NAN;
#ifdef STAGE_POWER
  if (status == OK)
    *error = pow(stage_error(&own, newton_in(workspace + SCRATCH).z, dq, ALL, DECAY, 0.0), STAGE_POWER);
#endif
  free(workspace);
  return status;
}

const void *NAME(provided_fallback)(void)
{
  static const fallback shared_fallback = {provided_step};
  return &shared_fallback;
}
