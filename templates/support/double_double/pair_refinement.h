#include "mixed_newton.h"
#ifdef MIXED_VELOCITIES
#include "../newton/newton_from_line.h"
#include "mixed_velocities.h"
#endif

/* Increments of a step in two words: by RATTLE or by the fixed-point iteration if that solved it in double, else by
 * Newton's method. Requires: pair_rattle.h if RATTLE_IN_PAIRS is defined. */

/* Replaces the increments of a step, solved in double, by those in two words. On failure they are undefined. */
static int refine_increments(const step_data *step, double *memory, double t_low, double h_low, double *dq, double *dp,
    double *passed, double *workspace)
{
#ifdef RATTLE_IN_PAIRS
  solved_step *solved = (solved_step *)step->points;
  if (solved->by_rattle) {
    const int status = refine_points(solved, step, memory + M * B + DEGREE, t_low, h_low, dq, dp);
    if (status == OK)
      return status;
  }
#elif defined(MIXED_VELOCITIES)
  solver_report report = {0};
  double unknowns[N + POINT]; /* memory has the velocities of the iteration */
  int status, keep;
  if (((solved_step *)step->points)->by_iteration && refine_velocities(step, t_low, h_low, dq, dp, passed) == OK)
    return OK;
  TRY(newton_from_line(step, newton_in(workspace), dp, &keep, &STANDARD_OPTIONS, &report));
  memory = unknowns;
  memcpy(memory, newton_in(workspace)->z, sizeof(double) * N);
#endif
  return refine_unknowns(step, memory, t_low, h_low, dq, dp, passed, workspace);
}
