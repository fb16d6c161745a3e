/* Runs over arrays in the caller's memory. Before it: indexed_threads.h, take_step of a solver, ERROR_POWER. */

solver_options NAME(default_options)(void)
{
  const solver_options options = {TOLERANCE, MAX_ITERATIONS, 0};
  return options;
}

static int take_steps(run_memory *run, const travel *way, solver_report *report)
{
  const long long n = NAME(coordinates)(way->given);
  while (report->steps < way->steps) {
    int status;
    report->t = run->t;
    status = take_step(run, way->given, n, way->options, report);
    if (status != OK)
      return status;
    add_compensated(&run->t, &run->t_low, run->h, 0.0);
    run->step++;
    report->steps++;
  }
  return OK;
}

int NAME(advance)(run_memory *run, const problem *given, long long steps, const solver_options *options,
    solver_report *report)
{
  const solver_options standard = NAME(default_options)();
  const travel way = {.go = take_steps, .given = given, .options = options ? options : &standard, .steps = steps};
  solver_report unread;
  report = report ? report : &unread;
  memset(report, 0, sizeof *report);
  return go_together(run, &way, report);
}

double NAME(step_error)(const run_memory *run)
{
  return pow(run->error, ERROR_POWER);
}
