#include "../core/status_codes.h"
#include "../core/step.h"

#include <string.h>

/* Newton solver that one library provides to another, which has only the fixed-point iteration. */

/* Computes the increments of a step with their low words, and the relative error of its end if the stages determine it,
 * otherwise NaN. Both libraries have the same first members of the step and of the run to which it refers. */
typedef struct {
  int (*step)(const step_data *step, double *dq, double *dp, const solver_options *options, solver_report *report,
      double *error, const error_measure *measure);
} fallback;

#ifdef LIBRARY_FALLBACK
/* Fallback to the Newton solver of another library, which is loaded on demand; the last number of the scratch contains
 * the pointer to it. While that is NULL, a step whose fixed-point iteration fails returns FALLBACK_REQUIRED, is not
 * performed, and has to be repeated. */
void NAME(set_fallback)(const void *shared_fallback, double *workspace)
{
  memcpy(workspace + SCRATCH - 1, &shared_fallback, sizeof shared_fallback);
}

/* Solves the step by the fallback library, which leaves its error estimate in the workspace. */
static SELDOM int fall_back(int status, const step_data *step, double *dq, double *dp, const solver_options *options,
    solver_report *report, double *workspace, const error_measure *measure)
{
  const fallback *library;
  memcpy(&library, step->scratch + SCRATCH - 1, sizeof library);
  if (!library)
    return STATUS(FALLBACK_REQUIRED);
  return library->step(step, dq, dp, options, report, workspace, measure);
}
#else
/* Newton solver for a library without it. Requires: fallback.h, FALLBACK_WORKSPACE. */
#include <stdlib.h>

static int provided_step(const step_data *step, double *dq, double *dp, const solver_options *options,
    solver_report *report, double *error, const error_measure *measure)
{
  double *workspace = malloc(sizeof(double) * STATUS(FALLBACK_WORKSPACE));
  step_data own = *step;
  int status;
  if (workspace == NULL)
    return STATUS(FALLBACK_REQUIRED);
  own.scratch = workspace;
  own.first = 1;
  own.tables = NULL;
  status = fall_back(NOT_CONVERGED, &own, dq, dp, options, report, workspace + SCRATCH, measure);
  *error = NAN;
#ifdef STAGE_POWER
  if (status == OK)
    *error = pow(stage_error(&own, newton_in(workspace + SCRATCH)->z, dq, measure->share, measure->decay, 0.0, 0.0),
        STAGE_POWER);
#endif
  free(workspace);
  return status;
}

const void *NAME(provided_fallback)(void)
{
  static const fallback shared_fallback = {provided_step};
  return &shared_fallback;
}
#endif
