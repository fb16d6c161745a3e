/* One step, and runs of many with compensated sums. Before it: step.h, time.h, prepare and solve of a solver, which
 * give the increments of a step to a finite state, duration, which says how long it lasts, and observe_error. */

solver_options NAME(default_options)(void)
{
  const solver_options options = {TOLERANCE, MAX_ITERATIONS, 0};
  return options;
}

int NAME(step)(real t, real h, const real *q0, const real *p0, const real *parameters, const solver_options *options,
    real *q1, real *p1, solver_report *report, real *workspace)
{
  const solver_options standard = NAME(default_options)();
  const real nothing[M] = {0};
  const step_data step = {t, h, q0, p0, nothing, nothing, parameters, workspace, 1, NULL};
  solver_report unread;
  solver_data data;
  real *memory = workspace + SCRATCH, dq[2 * M] = {0}, dp[2 * M] = {0}; /* increments, then their low parts */
  long long guess = 0;
  int status;
  report = report ? report : &unread;
  memset(report, 0, sizeof *report);
  report->t = t;
  prepare(&step, &data);
  status = solve(&step, &data, memory, &guess, dq, dp, options ? options : &standard, report, memory + MEMORY);
  if (status != OK)
    return status;
  report->duration = duration(&step, &data, memory, guess, memory + MEMORY);
  if (0 * report->duration != 0)
    return NOT_FINITE;
  report->steps = 1;
  for (int i = 0; i < M; i++) {
    q1[i] = q0[i] + (dq[i] + dq[M + i]);
    p1[i] = p0[i] + (dp[i] + dp[M + i]);
  }
  return OK;
}

void NAME(start)(run_memory *run, real t, real h, const real *q, const real *p)
{
  memset(run, 0, sizeof *run);
  run->t = t;
  run->h = h;
  memcpy(run->q, q, sizeof(real) * M);
  memcpy(run->p, p, sizeof(real) * M);
}

/* What a step changes, at hand while a call lasts. */
typedef struct {
  real t, t_low, q[M], p[M], carry_q[M], carry_p[M];
} state;

static void load_state(const run_memory *run, state *now)
{
  now->t = run->t;
  now->t_low = run->t_low;
  memcpy(now->q, run->q, sizeof now->q);
  memcpy(now->p, run->p, sizeof now->p);
  memcpy(now->carry_q, run->carry_q, sizeof now->carry_q);
  memcpy(now->carry_p, run->carry_p, sizeof now->carry_p);
}

static void save_state(const state *now, run_memory *run)
{
  run->t = now->t;
  run->t_low = now->t_low;
  memcpy(run->q, now->q, sizeof now->q);
  memcpy(run->p, now->p, sizeof now->p);
  memcpy(run->carry_q, now->carry_q, sizeof now->carry_q);
  memcpy(run->carry_p, now->carry_p, sizeof now->carry_p);
}

/* x + carry += increment with its low part, in twice the precision (Knuth's error of an addition, then Dekker's). */
static void add_compensated(real *x, real *carry, const real *increment)
{
  for (int i = 0; i < M; i++) {
    const real sum = x[i] + increment[i], part = sum - x[i];
    const real rest = ((x[i] - (sum - part)) + (increment[i] - part)) + (carry[i] + increment[M + i]);
    x[i] = sum + rest;
    carry[i] = rest - (x[i] - sum);
  }
}

int NAME(advance)(run_memory *run, long long steps, long long every, const real *parameters,
    const solver_options *options, real *t, real *q, real *p, int *iterations, solver_report *report, real *workspace)
{
  const solver_options standard = NAME(default_options)();
  state now;
  step_data step = {run->t, run->h, now.q, now.p, now.carry_q, now.carry_p, parameters, workspace, 1, NULL};
  solver_report unread;
  solver_data data;
  long long stored = 0;
  real passed = 0, dq[2 * M] = {0}, dp[2 * M] = {0}; /* time; increments, then their low parts */
  report = report ? report : &unread;
  memset(report, 0, sizeof *report);
  load_state(run, &now);
  prepare(&step, &data);
  for (long long k = 0; k < steps; k++) {
    const long long before = report->iterations;
    int status;
    step.first = k == 0;
    report->t = step.t = now.t;
    status = solve(&step, &data, run->memory, &run->guess, dq, dp, options ? options : &standard, report,
        workspace + SCRATCH);
    if (status == OK)
      passed = duration(&step, &data, run->memory, run->guess, workspace + SCRATCH);
    if (status == OK && 0 * passed != 0)
      status = NOT_FINITE;
    if (status != OK) {
      save_state(&now, run);
      return status;
    }
    observe_error(run, &step, &data, dq, workspace + SCRATCH);
    add_compensated(now.q, now.carry_q, dq);
    add_compensated(now.p, now.carry_p, dp);
    run->iterations += report->iterations - before;
    run->step++;
    add_to_time(&now.t, &now.t_low, passed);
    report->steps++;
    if (run->step % every == 0) {
      t[stored] = now.t;
      memcpy(q + stored * M, now.q, sizeof(real) * M);
      memcpy(p + stored * M, now.p, sizeof(real) * M);
      iterations[stored] = (int)run->iterations;
      run->iterations = 0;
      stored++;
    }
  }
  report->duration = passed;
  save_state(&now, run);
  return OK;
}
