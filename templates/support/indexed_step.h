/* A step whose equations were solved becomes the state. Before it: solve, go_on; tables LAST_ALONE, LAST,
 * BEFORE; coefficients.h. */

/* On to the end of the step; its error; from how many steps the next is guessed. */
static void accept(run_memory *run, long long n, double error, long long guess)
{
  if (run->error == run->error && !(error <= run->error)) {
    run->error = error;
    run->error_t = run->t;
  }
  go_on(run, n);
  run->guess = guess;
  run->turn = (run->turn + 1) % 3;
}

/* A step as long as the one before. */
static int take_step(run_memory *run, const problem *given, long long n, const solver_options *options,
    solver_report *report)
{
  const struct guess_tables tables = {LAST_ALONE, LAST, BEFORE};
  long long guess = run->guess;
  double error;
  const int status = solve(run, given, n, &tables, &guess, now_and_then(run), &error, options, report);
  if (status == OK)
    accept(run, n, error, guess);
  return status;
}
