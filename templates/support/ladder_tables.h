/* Which tables continue former steps into one of another length. Before it: LADDER_ALONE, LADDER_LAST, LADDER_BEFORE.
 *
 * Steps are roots of 2 to the power of a rung, so that a guess continues the curve of former steps by one of few
 * tables: from the last step, for each change of rung into the next; from the last two, for each pair of changes. */
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
