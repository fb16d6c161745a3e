/* Runs in a heat bath: steps O(h/2) Phi_h O(h/2), Phi the step without friction (phi_advance, run.h) and O half a
 * step of the bath. Noise is a function of (seed, trajectory, number of the step, half, coordinate). With
 * `metropolis` Phi is that of s h, s = 1 or -1 a variable of the run, and is accepted with probability min(1,
 * e^(-dH/kT)); otherwise the state stays and s changes its sign (Lelievre, Rousset & Stoltz, Free Energy
 * Computations, 2010, sec. 2.2). Requires: run.h, bath.h, energies.h. */

#define MOST_PARTS 64 /* of a failed step: it is halved six times */
#define LARGEST_RETURN_ERROR 1e-8 /* of Phi_-h(Phi_h(q)) relative to |q| and the step: it is reversible */
#define RETURN_ROUNDING 1e-14 /* relative to the largest coordinate, in which others may round */

/* Arguments of the steps of a run. */
typedef struct {
  const double *parameters;
  const solver_options *options;
  solver_report *report;
  double *workspace;
  const bath_factors *bath;
} bath_call;

/* Half a step of the bath. Iterations start from the state alone: earlier velocities are those before the noise. */
static void half_of_bath(run_memory *run, const bath_factors *bath, const double *numbers)
{
  add_compensated(&run->heat, &run->heat_low, exchange_heat(bath, numbers, run->p, run->carry_p), 0);
#ifndef EXPLICIT_RUN
  run->guess = 0;
#endif
}

/* Change of the energy between states, with forces frozen at t; NaN if it is undefined. */
static double energy_change(const bath_call *call, double t, const double *q0, const double *p0, const double *q1,
    const double *p1)
{
  double energy[2] = {NAN, NAN};
  NAME(energy)(t, q0, p0, call->parameters, &energy[0], call->workspace);
  NAME(energy)(t, q1, p1, call->parameters, &energy[1], call->workspace);
  return energy[1] - energy[0];
}

/* Status of a step: SPURIOUS_SOLUTION if, at a temperature, many iterations change the energy by more than kT and the
 * kinetic energy, K + max(0, U0 - U1), that the positions permit. */
static int status_of_root(const bath_call *call, const state *before, const double *q0, const double *p0,
    const double *q1, const double *p1)
{
  const double t = before->t, *q = before->q, *p = before->p, *terms = call->bath->terms; /* kT, momenta at rest */
  if (terms[0] == 0 || call->report->iterations <= FEW_ITERATIONS)
    return OK;
  const double now = energy_change(call, t, q0, terms + 1, q, p), later = energy_change(call, t, q1, terms + 1, q, p);
  const double change = fabs(energy_change(call, t, q0, p0, q1, p1));
  return change <= terms[0] + fmax(now, later) ? OK : STATUS(SPURIOUS_SOLUTION);
}

/* Repeats a failed step as two of h / 2, each in the same way if it fails: a function of the state alone. */
static int step_in_halves(const bath_call *call, const state *before, double h, double *q, double *p)
{
  int status = OK;
  memcpy(q, before->q, sizeof before->q);
  memcpy(p, before->p, sizeof before->p);
  for (int done = 0, size = MOST_PARTS / 2; done < MOST_PARTS && size; size = status == OK ? done & -done : size / 2) {
    const double part = h / MOST_PARTS;
    double q1[M], p1[M];
    status = NAME(step)(before->t + done * part, size * part, q, p, call->parameters, call->options, q1, p1,
        call->report, call->workspace);
    status = status == OK && size > 1 ? status_of_root(call, before, q, p, q1, p1) : status;
    if (status == OK) {
      done += size;
      memcpy(q, q1, sizeof q1);
      memcpy(p, p1, sizeof p1);
    }
  }
  return status;
}

/* Returns 1 if a step of h to the present state is accepted. */
static int is_accepted(const bath_call *call, const run_memory *run, const state *before, double h, double temperature)
{
  double chance, q[M], p[M], size[M], largest = 0;
  int reversible = 1;
  uniform_numbers(run->seed, (uint64_t)run->step, ACCEPTANCE, (uint32_t)run->trajectory, 1, &chance);
  if (!(log(chance) <= -energy_change(call, before->t, before->q, before->p, run->q, run->p) / temperature))
    return 0;
#ifndef EXPLICIT_RUN
  solver_report unread;
  if (NAME(step)(run->t, -h, run->q, run->p, call->parameters, call->options, q, p, &unread, call->workspace) != OK)
    return 0;
  for (int i = 0; i < M; i++) {
    size[i] = fabs(before->q[i]) + fabs(run->q[i] - before->q[i]);
    largest = fmax(largest, size[i]);
  }
  for (int i = 0; i < M; i++)
    reversible &= fabs(q[i] - before->q[i]) <= LARGEST_RETURN_ERROR * size[i] + RETURN_ROUNDING * largest;
#else
  (void)h, (void)q, (void)p, (void)size, (void)largest;
#endif
  return reversible;
}

/* Phi: in parts if it fails, or of s h, accepted or rejected. */
static int step_of_bath(const bath_call *call, run_memory *run, double temperature)
{
  const double h = run->h, signed_h = run->reversed ? -h : h;
  double q[M], p[M];
  state before;
  memcpy(&before, run, sizeof before);
  run->h = signed_h;
  int status = phi_advance(
      run, 1, 1, call->parameters, call->options, NULL, NULL, NULL, NULL, call->report, call->workspace);
  run->h = h;
#ifdef LIBRARY_FALLBACK
  if (status == STATUS(FALLBACK_REQUIRED))
    return status;
#endif
  if (status == OK && !run->metropolis && status_of_root(call, &before, before.q, before.p, run->q, run->p) == OK)
    return OK;
  run->step -= status == OK; /* as before the step */
  if (run->metropolis) {
    if (status == OK && is_accepted(call, run, &before, signed_h, temperature))
      run->accepted++;
    else {
      memcpy(run, &before, sizeof before);
      run->reversed = !run->reversed;
    }
  } else {
    TRY(step_in_halves(call, &before, h, q, p));
    memcpy(run->q, q, sizeof q);
    memcpy(run->p, p, sizeof p);
    memset(run->carry_q, 0, sizeof run->carry_q);
    memset(run->carry_p, 0, sizeof run->carry_p);
  }
  run->guess = 0;
  run->t = before.t, run->t_low = before.t_low;
  add_compensated(&run->t, &run->t_low, h, 0);
  run->step++;
  return OK;
}

int NAME(advance)(run_memory *run, long long steps, long long every, const real *parameters,
    const solver_options *options, real *t, real *q, real *p, int *iterations, solver_report *report, real *workspace)
{
  bath_factors bath;
  solver_report total = {0}, of_step;
  const bath_call call = {parameters, options, &of_step, workspace, &bath};
  double first[STEPS_DRAWN][DRAWN], second[STEPS_DRAWN][DRAWN];
  long long stored = 0;
  int status = steps == 0 || prepare_bath(&bath, run->t, run->h, run->q, parameters) ? OK : NOT_FINITE;
  status = cannot_store(t, every) ? STATUS(EVERY_BELOW_1) : status;
  for (int k = 0; total.steps < steps && status == OK; k = (k + 1) % STEPS_DRAWN) {
    const double heat = run->heat, heat_low = run->heat_low;
    const long long step = run->step;
    state now;
    memcpy(&now, run, sizeof now);
    total.t = now.t, total.duration = run->h;
    if (k == 0)
      normals(run->seed, (uint64_t)run->step, STEPS_DRAWN, HEAT, 0, DRAWN, (uint32_t)run->trajectory, 1, first[0],
          second[0]);
    half_of_bath(run, &bath, first[k]);
    status = step_of_bath(&call, run, bath.terms[0]);
    total.iterations += of_step.iterations, total.fallback_steps += of_step.fallback_steps;
    total.change = of_step.change, total.noise = of_step.noise;
#ifndef CONSTANT_BATH
    if (status == OK && !prepare_bath(&bath, run->t, run->h, run->q, parameters))
      status = NOT_FINITE;
#endif
    if (status != OK) { /* the state before the step */
      memcpy(run, &now, sizeof now);
      run->heat = heat, run->heat_low = heat_low, run->step = step;
      break;
    }
    half_of_bath(run, &bath, second[k]);
    total.steps++;
    if (t && run->step % every == 0) {
      memcpy(&now, run, sizeof now);
      store_row(run, &now, stored++, t, q, p, iterations);
    }
  }
  if (report)
    *report = total;
  return status;
}
