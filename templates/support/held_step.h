/* A step that constraints hold: parts of RATTLE. Before it: increments.h, add_forces, find_conditions, held_matrix.h,
 * indexed_iteration.h, PARTS of a step, PART and where they end, PART_END. */

#define NEAR_ENOUGH 1e-3 /* of a system: corrections are to make what is left less than that */

/* The parts of work: sizes of what is rounded; forces; increments of positions and
 * momenta; reactions; increments to be tried, and where they lead. */
typedef struct {
  double *X, *F, *dq, *dp, *R, *D, *Y;
} parts_of_work;

static parts_of_work divide(const run_memory *run, long long n)
{
  double *work = run->work;
  const parts_of_work parts = {work, work + n, work + 2 * n, work + 3 * n, work + 4 * n, work + 5 * n, work + 6 * n};
  return parts;
}

/* What the parts of a step have in common. */
typedef struct {
  run_memory *run;
  const problem *given;
  parts_of_work parts;
  held held;
  long long n;
  const solver_options *options;
  solver_report *report;
} held_run;

static held_run held_run_of(run_memory *run, const problem *given, const solver_options *options, solver_report *report)
{
  const long long n = NAME(coordinates)(given);
  const held_run of = {run, given, divide(run, n), held_of(run, n), n, options, report};
  return of;
}

/* x = G^T lambda. */
static void find_reactions(const held *held, const double *lambda, double *x, long long n)
{
  memset(x, 0, sizeof(double) * (size_t)n);
  for (long long k = 0; k < held->count; k++)
    for (int e = held->of.first[k]; e < held->of.first[k + 1]; e++)
      x[held->of.place[e]] += held->slope[e] * lambda[k];
}

static void find_forces(const held_run *of, const double *X, double t, double *F)
{
  memset(F, 0, sizeof(double) * (size_t)of->n);
  add_forces(of->run, of->given, X, t, 1.0, F);
}

/* Forces, slopes and their matrix at the state. */
static int begin(const held_run *of)
{
  find_forces(of, of->run->q, of->run->t, of->parts.F);
  find_conditions(of->given, of->run->q, of->run->t, of->held.g, of->held.rate, of->held.slope);
  return assemble(&of->held, of->run->inverse_mass) ? OK : SINGULAR;
}

/* The increments that reactions lead to, the positions, and sizes of what these are sums of; returned is the size of
 * the coordinates, squared. */
static double lead(const held_run *of, double h)
{
  const run_memory *run = of->run;
  const parts_of_work *parts = &of->parts;
  double size = 0.0;
  for (long long i = 0; i < of->n; i++) {
    const double p = run->p[i] + parts->dp[i], pushed = h / 2 * parts->R[i];
    const double drift = h * (run->inverse_mass[i] * (p + pushed));
    parts->D[i] = parts->dq[i] + drift;
    parts->Y[i] = run->q[i] + parts->D[i];
    parts->X[i] = fabs(run->q[i]) + fabs(h * run->inverse_mass[i]) * (fabs(p) + fabs(pushed));
    size += parts->X[i] * parts->X[i];
  }
  return size;
}

/* x += by y; returned is the size of M^-1 y, squared. */
static double push(double *x, const double *y, double by, const double *inverse_mass, long long n)
{
  double size = 0.0;
  for (long long i = 0; i < n; i++) {
    const double moved = inverse_mass[i] * y[i];
    x[i] += by * y[i];
    size += moved * moved;
  }
  return size;
}

/* What is said of corrections that came to an end; constraints that are not met where positions rest contradict each
 * other. */
static int end_of(const iteration *now, const held *held)
{
  const double left = product_of(held->right, held->right, held->count);
  const double grain = product_of(held->grain, held->grain, held->count);
  if (now->status < 0)
    return failure_of(now);
  return left <= GRAINS * GRAINS * grain ? OK : SINGULAR;
}

/* Reactions at the beginning that lead to g = 0 at the end, and the slopes there; increments are to be tried. */
static int meet(const held_run *of, double h, double t, double *size)
{
  const held *held = &of->held;
  const parts_of_work *parts = &of->parts;
  iteration now = at_its_start();
  find_reactions(held, held->lambda, parts->R, of->n);
  for (;;) {
    int status;
    double moved;
    *size = lead(of, h);
    find_conditions(of->given, parts->Y, t, held->g, held->rate, held->next);
    for (long long k = 0; k < held->count; k++)
      held->right[k] = -2.0 / (h * h) * held->g[k];
    find_grain(held, held->next, parts->X, 2.0 / (h * h));
    if (now.status)
      return end_of(&now, held);
    status = solve_held(held, NEAR_ENOUGH, of->report);
    if (status != OK)
      return status;
    add_to(held->lambda, held->change, 1.0, held->count);
    find_reactions(held, held->change, parts->F, of->n);
    moved = h * h / 2 * (h * h / 2) * push(parts->R, parts->F, 1.0, of->run->inverse_mass, of->n);
    judge(&now, beside_state(moved, *size, of->options), of->options, of->report);
  }
}

/* right = - so many times (rate + G x). */
static void find_right(const held *held, const double *rate, const double *x, double scale)
{
  for (long long k = 0; k < held->count; k++) {
    double sum = rate[k];
    for (int e = held->of.first[k]; e < held->of.first[k + 1]; e++)
      sum += held->slope[e] * x[held->of.place[e]];
    held->right[k] = -scale * sum;
  }
}

/* Momenta on to G M^-1 p + g_t = 0, by reactions that push by so much; velocities are judged in units of the size. X
 * has sizes of what these are sums of. */
static int turn(const held_run *of, double by, double unit, double size)
{
  const held *held = &of->held;
  const run_memory *run = of->run;
  iteration now = at_its_start();
  for (;;) {
    int status;
    double moved;
    for (long long i = 0; i < of->n; i++)
      of->parts.D[i] = run->inverse_mass[i] * (run->p[i] + of->parts.dp[i]);
    find_right(held, held->rate, of->parts.D, 1.0 / by);
    find_grain(held, held->slope, of->parts.X, 1.0 / by);
    if (now.status)
      return now.status < 0 ? failure_of(&now) : OK;
    status = solve_held(held, NEAR_ENOUGH, of->report);
    if (status != OK)
      return status;
    find_reactions(held, held->change, of->parts.R, of->n);
    moved = unit * by * (unit * by) * push(of->parts.dp, of->parts.R, by, run->inverse_mass, of->n);
    judge(&now, beside_state(moved, size, of->options), of->options, of->report);
  }
}

/* A part of a step, of h to t. */
static int hold(const held_run *of, double h, double t)
{
  const parts_of_work *parts = &of->parts;
  const held *held = &of->held;
  const run_memory *run = of->run;
  double size;
  int status;
  add_to(parts->dp, parts->F, h / 2, of->n);
  status = meet(of, h, t, &size);
  if (status != OK)
    return status;
  add_to(parts->dp, parts->R, h / 2, of->n);
  memcpy(parts->dq, parts->D, sizeof(double) * (size_t)of->n);
  memcpy(held->slope, held->next, sizeof(double) * (size_t)held->entries);
  if (!assemble(held, run->inverse_mass))
    return SINGULAR;
  find_forces(of, parts->Y, t, parts->F);
  find_reactions(held, held->lambda, parts->R, of->n);
  for (long long i = 0; i < of->n; i++) {
    parts->dp[i] += h / 2 * (parts->F[i] + parts->R[i]);
    parts->X[i] = run->inverse_mass[i] *
        (fabs(run->p[i] + parts->dp[i]) + fabs(h / 2) * (fabs(parts->F[i]) + fabs(parts->R[i])));
  }
  return turn(of, h / 2, h, size);
}

/* Increments begin with what rounding cut off the state; a step that fails leaves the state, and begins anew. */
static int take_step(run_memory *run, const problem *given, long long n, const solver_options *options,
    solver_report *report)
{
  const held_run of = held_run_of(run, given, options, report);
  int status = OK;
  run->error = NAN;
  if (!run->guess) {
    memset(of.held.lambda, 0, sizeof(double) * (size_t)of.held.count);
    status = begin(&of);
  }
  run->guess = 0;
  memcpy(of.parts.dq, run->carry_q, sizeof(double) * (size_t)n);
  memcpy(of.parts.dp, run->carry_p, sizeof(double) * (size_t)n);
  for (int k = 0; status == OK && k < PARTS; k++)
    status = hold(&of, run->h * PART[k], run->t + run->h * PART_END[k]);
  if (status != OK)
    return status;
  add_all(run->q, of.parts.dq, run->carry_q, n);
  add_all(run->p, of.parts.dp, run->carry_p, n);
  run->guess = 1;
  return OK;
}
