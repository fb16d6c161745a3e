/* Steps of one length tau in a time with dt = g dtau: h = tau / rho, where the density of steps rho = 1/g is carried
 * along by its own equation of motion, drho/dtau = -d(log g)/dt, from the middle of one step to that of the next. So
 * the steps are the same backward, if the method's are (Hairer and Soederlind's integrating controller, SIAM J. Sci.
 * Comput. 26, 2005). A step that ends at a given time is a part of tau, and takes the density on by as much.
 * Before it: run.h, prepare and solve of a solver, the kernel density: 1/g and -d(log g)/dt. After it: advance_to.h. */

#define LAST_STEP REAL(1e-6) /* a step that ends so near the end, as a part of it, ends there */

/* What the trials of a step share. */
typedef struct {
  state at;
  step_data step;
  solver_data data;
  real t_end, tau, density, part, growth; /* growth: of the density, in half of a whole step */
  real dq[2 * M], dp[2 * M]; /* increments, then their low parts */
  int last; /* whether the step ends at t_end */
  int turned; /* whether the run goes back on what it came */
} trial;

static void begin_trials(run_memory *run, trial *now, real tau, solver_options *standard)
{
  (void)standard;
  now->tau = tau;
  now->turned = (real)run->direction * ((now->t_end - run->t) - run->t_low) < 0;
}

/* The density in the middle of the next step, if it is a whole one: where the run turns, of the last one. */
static int next_density(const run_memory *run, trial *now)
{
  const real half = (real)run->direction * now->tau / 2, halves = now->turned ? 1 - run->part : 1 + run->part;
  real u[2 * M], value[2];
  const int status = density_arguments(&now->step, u);
  if (status != OK)
    return status;
  density(u, now->at.t, now->step.parameters, value);
  now->growth = half * value[1];
  now->density = run->density > 0 ? run->density + halves * now->growth : value[0] + now->growth;
  return now->density > 0 && 0 * now->density == 0 ? OK : NOT_FINITE;
}

/* The step that the run is at. */
static int find_step(run_memory *run, trial *now, const solver_options *options, solver_report *report)
{
  const real rest = (now->t_end - now->at.t) - now->at.t_low;
  int status;
  report->t = now->step.t = now->at.t;
  status = next_density(run, now);
  if (status != OK)
    return status;
  now->step.h = MATH(copysign)(now->tau / now->density, rest);
  now->last = MATH(fabs)(now->step.h) * (1 + LAST_STEP) >= MATH(fabs)(rest);
  now->part = 1;
  if (now->last) {
    now->step.h = rest;
    now->density = (now->density - now->growth) / (1 - MATH(fabs)(rest) / now->tau * now->growth);
    now->part = MATH(fabs)(rest) * now->density / now->tau;
  }
  prepare(&now->step, &now->data);
  run->guess = 0; /* that of a step of another length */
  return solve(&now->step, &now->data, run->memory, &run->guess, now->dq, now->dp, options, report,
      now->step.scratch + SCRATCH);
}

static int confirm_step(run_memory *run, trial *now, const solver_options *options, solver_report *report)
{
  (void)report;
  return observe_error(run, &now->step, &now->data, now->dq, now->dp, options, now->step.scratch + SCRATCH);
}

/* Makes the step that was found the state. */
static void take_step(run_memory *run, trial *now)
{
  add_compensated(now->at.q, now->at.carry_q, now->dq);
  add_compensated(now->at.p, now->at.carry_p, now->dp);
  if (now->last) {
    now->at.t = now->t_end;
    now->at.t_low = 0;
  } else {
    add_to_time(&now->at.t, &now->at.t_low, now->step.h);
  }
  run->density = now->density;
  run->part = now->part;
  now->turned = 0;
  run->step++;
}
