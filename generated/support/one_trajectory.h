/* Sweeps of one trajectory: what is kept of its last steps, and when a step is done. Before it: points.h,
 * contraction.h, and the tables LAST_ALONE, LAST, BEFORE, which continue what was kept into the next step. */

/* What is kept at the points, of the last step and of the one before. */
typedef double *history;

/* In memory the points of a coordinate follow each other. */
static inline void lanes_load(const double *memory, lanes (*x)[M])
{
  for (int i = 0; i < M; i++)
    for (int n = 0; n < GROUPS; n++)
      memcpy(&x[n][i], memory + i * POINTS + n * LANES, sizeof(lanes));
}

static inline void lanes_store(lanes (*x)[M], double *memory)
{
  for (int i = 0; i < M; i++)
    for (int n = 0; n < GROUPS; n++)
      memcpy(memory + i * POINTS + n * LANES, &x[n][i], sizeof(lanes));
}

/* Where to compute what is to be kept. */
static inline coordinates *kept(history past, coordinates *own)
{
  (void)past;
  return own;
}

/* What is kept at the points, continued into this step from the last one or from the last two. */
static inline void continue_curve(const step_data *step, const double *past, long long steps, lanes (*x)[M])
{
  const struct guess_tables of_one_length = {LAST_ALONE, LAST, BEFORE};
  const struct guess_tables *tables = step->tables ? step->tables : &of_one_length;
  lanes last[GROUPS][M], before[GROUPS][M];
  lanes_load(past, last);
  lanes_load(past + M * POINTS, before);
  for (int i = 0; i < M; i++)
    for (int n = 0; n < GROUPS; n++)
      x[n][i] = steps == 1 ? apply(tables->alone, n, last, i)
                           : apply(tables->last, n, last, i) + apply(tables->before, n, before, i);
}

static inline void remember_curve(lanes (*x)[M], history past)
{
  memcpy(past + M * POINTS, past, sizeof(double) * M * POINTS);
  lanes_store(x, past);
}

/* The velocities of a motion on a straight line. */
static inline int start_velocities(const step_data *step, lanes (*z)[M])
{
  double v[M];
  const int status = NAME(velocity)(step->t, step->q0, step->p0, step->parameters, v, step->scratch);
  for (int n = 0; status == OK && n < GROUPS; n++)
    for (int i = 0; i < M; i++)
      z[n][i] = lanes_of(v[i]);
  return status;
}

/* How the sweeps of a step come on: the first change, the last two; the one that they were stirred at, if any, and for
 * how many sweeps they have been. */
typedef struct {
  double first, last, before, stirred;
  int status, since;
} progress;

static inline progress before_sweeps(void)
{
  const progress none = {0.0, INFINITY, INFINITY, 0.0, 0, 0};
  return none;
}

static inline int needs_sweep(const progress *now)
{
  return now->status == 0;
}

static inline void take_change(progress *now, double change, const solver_options *options, int k,
    solver_report *report)
{
  now->status = sweep_status(change, now->last, options, k);
  now->first = k == 0 ? change : now->first;
  now->before = now->last;
  now->last = change;
  report->iterations++;
}

#define STIR 1e3 /* times the last change, which has to shrink again to about what it was, */
#define STIRRED_SWEEPS 3 /* in so many sweeps: */
#define ABOUT 16.0 /* fourfold, squared */
#define STIRRED_LEVEL 1e-16 /* changes below 1e-8 of the state */

/* Whether sweeps that shrink no longer are at rest, or what else is to be done with them: 1, to stir them. */
static SELDOM int tell_rest(progress *now, const solver_options *options, int k)
{
  if (now->stirred > 0.0) {
    now->since++;
    now->status = now->last <= ABOUT * now->stirred ? 1 : -(now->since == STIRRED_SWEEPS);
    return 0;
  }
  if (options->absolute || !(now->last < STIRRED_LEVEL) || k + STIRRED_SWEEPS >= options->max_iterations)
    return 0;
  now->stirred = now->last;
  now->last = INFINITY;
  now->status = 0;
  return 1;
}

/* Whether the last change is to be magnified, to see whether it shrinks. Where masses are nearly singular, rounding
 * alone changes velocities by more than any fixed level; but sweeps that contract slowly stop shrinking there, too.
 * What was rounding is gone in a sweep or two, what was slow is not. */
static inline int stirs(progress *now, const solver_options *options, int k)
{
  return now->status <= 0 && (now->stirred > 0.0 || now->last >= now->before) ? tell_rest(now, options, k) : 0;
}

/* What the sweeps came to. */
static inline int outcome(const progress *now, solver_report *report)
{
  report->change = sqrt(now->last);
  if (now->status < 0)
    return now->last < INFINITY ? NOT_CONVERGED : NOT_FINITE;
  return OK;
}

/* Whether the increments are to be added. */
static inline int accept(const step_data *step, const double *dq, const double *dp, solver_report *report)
{
  (void)report;
  return reaches(step, dq, dp);
}

static inline long long next_guess(long long steps, const progress *now, const solver_report *report)
{
  (void)report;
  return steps_to_continue(steps, now->first);
}
