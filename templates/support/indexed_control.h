/* Adaptive integration of indexed systems to a given time. Requires: trials.h. */

static void take_trial(run_memory *run, trial *now)
{
  accept(run, now->n, larger(now->error, now->apart), now->guess);
  if (now->last) {
    now->at.t = now->t_end;
    now->at.t_low = 0.0;
    run->guess = 0;
  } else {
    add_compensated(&now->at.t, &now->at.t_low, run->h, 0.0);
    choose_size(run, now);
  }
  run->t = now->at.t;
  run->t_low = now->at.t_low;
  run->step++;
}

static int take_trials(run_memory *run, const job *way, solver_report *report)
{
  solver_options standard = NAME(default_options)();
  trial now = {
      .given = way->given, .n = NAME(coordinates)(way->given), .t_end = way->t_end, .at = {run->t, run->t_low}};
  const solver_options *options = way->options ? way->options : &standard;
  begin_trials(run, &now, way->tolerance, &standard);
  run->direction = (way->t_end - run->t) - run->t_low < 0 ? -1 : 1;
  while (report->steps < way->steps && (run->t != way->t_end || run->t_low != 0.0)) {
    int status = find_step(run, &now, options, report);
    if (status == OK)
      status = confirm_step(run, &now, options, report);
    if (status != OK)
      return status;
    take_trial(run, &now);
    report->steps++;
  }
  return OK;
}

int NAME(advance_to)(run_memory *run, const problem *given, double t_end, double tolerance, long long steps,
    const solver_options *options, solver_report *report)
{
  const job way = {take_trials, given, options, t_end, tolerance, steps};
  solver_report unread;
  report = report ? report : &unread;
  memset(report, 0, sizeof *report);
  return run_workers(run, &way, report);
}
