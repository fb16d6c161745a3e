/* Predictor tables for steps of different sizes. Requires: LADDER_ALONE, LADDER_LAST, LADDER_BEFORE.
 *
 * Step sizes are roots of 2 to the power of a level, so that few tables extrapolate the curve of former steps: from the
 * last step, one for each change of level; from the last two, one for each pair of changes. */
enum {
  CHANGES = sizeof LADDER_ALONE / sizeof *LADDER_ALONE,
  REACH = CHANGES / 2
};

/* Selects the tables for the next step; returns 0 if there are none. */
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
