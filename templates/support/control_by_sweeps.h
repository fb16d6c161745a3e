/* Trials of steps that choose their length, by sweeps. Before it: run.h, a sweep with curve_error.h, and the ladder:
 * LADDER_ALONE, LADDER_LAST, LADDER_BEFORE.
 *
 * Steps are roots of 2 to the power of a rung, so that a guess continues the curve of former steps by one of few
 * tables: from the last step, for each change of rung into the next; from the last two, for each pair of changes. */
#define SHORT_STEPS_FAIL 1 /* their changes are held against velocities that are hardly more than rounding */

enum {
  CHANGES = sizeof LADDER_ALONE / sizeof *LADDER_ALONE,
  REACH = CHANGES / 2
};

/* The tables that continue the steps before into the next; whether there are any. */
static inline int choose_tables(const run_memory *run, struct guess_tables *tables)
{
  const long long last = run->change_before + REACH, next = run->change + REACH;
  if (next < 0 || next >= CHANGES || (run->guess == 2 && (last < 0 || last >= CHANGES)))
    return 0;
  tables->alone = LADDER_ALONE[next];
  if (run->guess == 2) {
    tables->last = LADDER_LAST[last][next];
    tables->before = LADDER_BEFORE[last][next];
  }
  return 1;
}

/* Increments, and what their curve leaves unresolved, if more than `least`; infinity where there are none. Afresh:
 * without a guess. */
static inline double attempt(run_memory *run, step_data *step, const solver_data *data, int afresh, long long *guess,
    double *dq, double *dp, double decay, double least, const solver_options *options, solver_report *report)
{
  struct guess_tables tables;
  int status;
  step->tables = &tables;
  *guess = afresh || !choose_tables(run, &tables) ? 0 : run->guess;
  status = sweep(step, data, run->memory, guess, dq, dp, options, report);
  step->tables = NULL;
  if (status != OK)
    return INFINITY;
  return curve_error(step, data, run->memory, dq, EACH, decay, least);
}
