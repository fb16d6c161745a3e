/* Runs over arrays in the caller's memory. Before it: take_step of a solver, ERROR_POWER. */

solver_options NAME(default_options)(void)
{
  const solver_options options = {TOLERANCE, MAX_ITERATIONS, 0};
  return options;
}

int NAME(advance)(run_memory *run, const problem *given, long long steps, const solver_options *options,
    solver_report *report)
{
  const solver_options standard = NAME(default_options)();
  const long long n = NAME(coordinates)(given);
  solver_report unread;
  report = report ? report : &unread;
  memset(report, 0, sizeof *report);
  for (long long k = 0; k < steps; k++) {
    int status;
    report->t = run->t;
    status = take_step(run, given, n, options ? options : &standard, report);
    if (status != OK)
      return status;
    add_compensated(&run->t, &run->t_low, run->h, 0.0);
    run->step++;
    report->steps++;
  }
  return OK;
}

double NAME(step_error)(const run_memory *run)
{
  return pow(run->error, ERROR_POWER);
}
