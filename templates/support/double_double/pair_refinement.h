#include "mixed_newton.h"
#ifdef RATTLE_IN_PAIRS
#include "pair_rattle.h"
#endif

/* Increments of a step in two words, by RATTLE if that solved it in double, else by Newton's method. */

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
#endif
  return refine_unknowns(step, memory, t_low, h_low, dq, dp, passed, workspace);
}
