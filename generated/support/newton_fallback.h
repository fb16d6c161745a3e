/* Where sweeps fail, Newton's iteration. Before it: newton.h; stage_error.h, where the stages tell their error. */

#define MOST_ERROR 1.0 /* of a step, relative to the state: beyond it another solution of the equations may be found */
#define NEARLY_LINEAR 8 /* iterations: what so few solve, rounding included, has one solution near, however stiff */

/* Whether the stages solve their equations and are far from any motion. */
static SELDOM int strays(const step_data *step, const double *z, const double *dq)
{
#ifdef STAGE_POWER
  return !(pow(stage_error(step, z, dq, ALL, 0.0), STAGE_POWER) <= MOST_ERROR);
#else
  (void)step, (void)z, (void)dq;
  return 0;
#endif
}

static SELDOM int fall_back(int status, const step_data *step, double *dq, double *dp, const solver_options *options,
    solver_report *report, double *workspace)
{
  const newton_data newtons = newton_in(workspace);
  const long long before = report->iterations;
  int keep;
  status = newton_from_line(step, &newtons, dp, &keep, options, report);
  gather(END_POSITION, 1, step->h, newtons.z, M, dq, 0, 1);
  memset(dq + M, 0, sizeof(double) * M);
  memset(dp + M, 0, sizeof(double) * M);
  if (status == OK && report->iterations - before > NEARLY_LINEAR && strays(step, newtons.z, dq))
    return STATUS(STRAYED);
  return status;
}
