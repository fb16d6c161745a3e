#include "../core/step.h"
#include "array_memory.h"
#include "arrays.h"

/* Splitting steps of an array system, with the equations of splitting.h, in few passes over memory. A pass adds the
 * forces of a kick and continues the coordinates behind them to the positions of the next kick, also into the next
 * step. Within a step the increments are in the memory of the compensation terms. Infinite and undefined numbers remain
 * in a state, so that many steps are checked at once; if one fails, they are repeated one by one. With PLAIN_SUMS
 * increments are added to the state at once, and their rounding errors are dropped; the kicks at the end of a step and
 * at the start of the next one are one where steps are checked together. Requires: LEAPS, TOGETHER, EQUAL_MASSES, the
 * tables, later add_forces; with ROWS array_rows.h. */
static void add_forces(const run_memory *run, const problem *arrays, const double *X, double t, double by, double *F);

/* Workspace: positions of the next kick, forces at the end of a step; the state before steps that are checked. */
typedef struct {
  long long n; /* coordinates */
  double *X, *F, *before;
  int equal_masses;
} work_arrays;

#ifdef PLAIN_SUMS
#define INCREMENTS(run) (run)->p /* kicks add to the momenta themselves, */
#define POSITIONS(run, work) (run)->q /* drifts to the positions */
#else
#define INCREMENTS(run) (run)->carry_p
#define POSITIONS(run, work) (work)->X
#endif

enum { SECTION = 512 }; /* coordinates that stay in the first cache */

static work_arrays bind_work_arrays(const run_memory *run, long long n)
{
  double *work = run->work;
  work_arrays of = {n, work, work + n, work + 2 * n, 0};
  for (long long i = 0; i < n; i++)
    of.equal_masses |= run->inverse_mass[i] != run->inverse_mass[0];
  of.equal_masses = !of.equal_masses;
  return of;
}

/* What follows the forces of a kick: a step ends, one starts, a drift, the last one of its step. */
typedef struct {
  int ends, starts, moves, arrives;
  double end, start, drift; /* factors of the forces in these steps, and of the velocity */
} continuation;

/* Returns 1 if the last kick is at the end of a step: its forces are those of the first kick of the next step. */
static inline int ends_with_a_kick(void)
{
  return KICK[0] != 0.0 && KICK[LEAPS - 1] != 0.0 && DRIFT[LEAPS - 1] == 0.0;
}

/* Values that are added to consecutive coordinates, with a sign. */
typedef struct {
  const double *values;
  double sign;
} addend;

/* x and `by` times the values. */
static inline __attribute__((always_inline)) double plus(double x, double by, const addend *added, int addends,
    long long i)
{
  for (int k = 0; k < addends; k++)
    x += (by * added[k].sign) * added[k].values[i];
  return x;
}

#ifndef PLAIN_SUMS
/* Moves `count` coordinates, apart from kicks, so that sums of more elements overlap in time. */
static inline __attribute__((always_inline)) void drift_coordinates(double *restrict q, const double *restrict p,
    double *restrict dq, const double *restrict dp, double *restrict X, const double *restrict inverse_mass,
    long long count, int arrives, double by)
{
  const double drift = by * inverse_mass[0]; /* of equal masses */
#pragma GCC unroll 2
  for (long long i = 0; i < count; i++) {
    double at = q[i], more_q = dq[i] + (EQUAL_MASSES ? drift : by * inverse_mass[i]) * (p[i] + dp[i]);
    if (arrives) {
      add_increment(&at, &more_q);
      q[i] = at;
    } else
      X[i] = at + more_q;
    dq[i] = more_q;
  }
}
#endif

/* Continues `count` coordinates behind the last forces, `addends` values of each, which kicks multiply by `factor`.
 * Forces that were used in both steps become 0 for the next ones, as they are before if `fresh`. */
static inline __attribute__((always_inline)) void continue_coordinates(double *restrict q, double *restrict p,
    double *restrict dq, double *restrict dp, double *restrict X, double *restrict F,
    const double *restrict inverse_mass, long long count, continuation by, double factor, const addend *added,
    int addends, int fresh)
{
  const int forces = by.starts || (by.ends && ends_with_a_kick()); /* F, else increments that have them */
#ifdef PLAIN_SUMS
  const double drift = by.drift * inverse_mass[0]; /* of equal masses */
  for (long long i = 0; i < count; i++) {
    if (forces)
      p[i] += (by.starts ? by.start : by.end) * F[i];
    else if (addends)
      p[i] = plus(p[i], factor, added, addends, i);
    if (by.starts)
      F[i] = 0.0;
    if (by.moves)
      q[i] += (EQUAL_MASSES ? drift : by.drift * inverse_mass[i]) * p[i];
  }
#else
  if (by.ends || by.starts || addends)
#pragma GCC unroll 2
    for (long long i = 0; i < count; i++) { /* two registers at a time: counting took a sixth of the instructions */
      double moving = p[i], more_p = forces ? dp[i] : plus(dp[i], factor, added, addends, i);
      double force = forces && !fresh ? plus(F[i], 1.0, added, addends, i) : 0.0;
      if (forces && fresh)
        force = plus(added[0].sign * added[0].values[i], 1.0, added + 1, addends - 1, i);
      if (by.ends) {
        if (forces)
          more_p += by.end * force;
        add_increment(&moving, &more_p);
        p[i] = moving;
      }
      if (by.starts) {
        more_p += by.start * force;
        if (!fresh)
          F[i] = 0.0;
      }
      dp[i] = more_p;
    }
  if (by.moves)
    drift_coordinates(q, p, dq, dp, X, inverse_mass, count, by.arrives, by.drift);
#endif
}

/* Continues up to SECTION coordinates; the flags are constants of each loop. */
static inline __attribute__((always_inline)) void continue_part(const run_memory *run, const work_arrays *work,
    section here, continuation by, double factor, const addend *added, int addends, int fresh)
{
  const long long first = here.first;
  const double *masses = run->inverse_mass + (work->equal_masses ? 0 : first);
#define CONTINUE(ends, starts, moves, arrives)                                                                      \
  continue_coordinates(run->q + first, run->p + first, run->carry_q + first, run->carry_p + first, work->X + first, \
      work->F + first, masses, here.end - first,                                                                    \
      (continuation){ends, starts, moves, arrives, by.end, by.start, by.drift}, factor, added, addends, fresh)
  if ((LEAPS > 2 || !ends_with_a_kick()) && by.moves && !by.arrives) {
    if (by.ends)
      CONTINUE(1, 1, 1, 0);
    else if (by.starts)
      CONTINUE(0, 1, 1, 0);
    else
      CONTINUE(0, 0, 1, 0);
  } else if (by.ends && by.starts)
    CONTINUE(1, 1, 1, 1);
  else if (by.ends && by.moves)
    CONTINUE(1, 0, 1, 1);
  else if (by.ends)
    CONTINUE(1, 0, 0, 0);
  else if (by.starts)
    CONTINUE(0, 1, 1, 1);
  else
    CONTINUE(0, 0, 1, 1);
#undef CONTINUE
}

static void continue_section(const run_memory *run, const work_arrays *work, section here, continuation by)
{
  for (section part = here; part.first < here.end; part.first = part.end) {
    part.end = here.end - part.first < SECTION ? here.end : part.first + SECTION;
    continue_part(run, work, part, by, 0.0, NULL, 0, 0);
  }
}

#ifdef ROWS
#include "array_rows.h"
#endif

/* Kick k: adds `by` times the forces at X to F, and continues all coordinates. Blocks of rows come in alternating
 * directions: the last ones of a kick are in the second cache at the start of the next one. */
static void kick(const run_memory *run, const problem *arrays, const work_arrays *work, int k, const double *X,
    double by, double *F, continuation then)
{
  const double t = run->t + KICK_ABSCISSA[k] * run->h;
#ifdef ROWS
  const int backward = (run->step * (LEAPS - 1) + k) % 2 != 0;
  if (kick_by_rows(run, arrays, work, X, t, by, F, &then, backward))
    return;
#endif
  add_forces(run, arrays, X, t, by, F);
  continue_section(run, work, mine(run, work->n), then);
}

/* The first drift of a step, with the first kick if its forces are known. */
static continuation starting(double h, int ends, int starts)
{
  const int arrives = LEAPS == 2 && ends_with_a_kick();
  return (continuation){ends, starts, 1, arrives, h * KICK[LEAPS - 1], h * KICK[0], h * DRIFT[0]};
}

/* Performs a step; `continues` from a former one, and into a next one. */
static void take_step(run_memory *run, const problem *arrays, const work_arrays *work, int continues, int into_next)
{
  const double h = run->h;
  const int last = LEAPS - 1, kicks_end = ends_with_a_kick();
  if (!kicks_end)
    wait_at_barrier(run); /* other threads may continue coordinates of the former step */
  if (!continues && (run->guess || !kicks_end))
    continue_section(run, work, mine(run, work->n), starting(h, 0, kicks_end));
  else if (!continues)
    kick(run, arrays, work, 0, run->q, h * KICK[0], INCREMENTS(run), starting(h, 0, 0));
  for (int k = 1; k < last + !kicks_end; k++) {
    const continuation then = {.ends = k == last, .moves = 1, .arrives = k == last - kicks_end, .drift = h * DRIFT[k]};
    kick(run, arrays, work, k, POSITIONS(run, work), h * KICK[k], INCREMENTS(run), then);
  }
#ifdef PLAIN_SUMS
  if (kicks_end && into_next) /* with the first kick of the next step */
    kick(run, arrays, work, last, run->q, h * (KICK[last] + KICK[0]), run->p, starting(h, 0, 0));
  else
#endif
      if (kicks_end) {
    const continuation then = into_next ? starting(h, 1, 1) : (continuation){.ends = 1, .end = h * KICK[last]};
    kick(run, arrays, work, last, run->q, 1.0, work->F, then);
  }
  run->guess = kicks_end;
}

/* Copies this thread's part of the state and of the forces at its end, or copies it back. */
static void copy_state(const run_memory *run, const work_arrays *work, int back)
{
#ifdef PLAIN_SUMS
  double *const now[] = {run->q, run->p, work->F};
#else
  double *const now[] = {run->q, run->p, run->carry_q, run->carry_p, work->F};
#endif
  const section own = mine(run, work->n);
  for (int k = 0; k < (int)(sizeof now / sizeof *now); k++) {
    double *here = now[k] + own.first, *saved = work->before + k * work->n + own.first;
    memcpy(back ? here : saved, back ? saved : here, sizeof(double) * (size_t)(own.end - own.first));
  }
}

static int is_state_finite(const run_memory *run, long long n)
{
  sums all;
  wait_at_barrier(run);
  begin_sums(&all, run, n);
  while (next_block(&all)) {
    const section here = all.here;
    const int count = (int)(here.end - here.first);
    add_block(&all, !(all_finite(run->q + here.first, count) && all_finite(run->p + here.first, count)), 0.0);
  }
  wait_at_barrier(run);
  return sum_of(&all, 0) == 0.0;
}

/* Performs up to `most` steps; after a failure the state is that before the step that failed. */
static int perform_steps(run_memory *run, const problem *arrays, const work_arrays *work, const solver_options *options,
    solver_report *report, long long most)
{
  long long together = TOGETHER;
  run->error = NAN;
  while (most > 0) {
    const run_memory before = *run;
    const solver_report report_before = *report;
    const long long count = most < together ? most : together;
    const section own = mine(run, work->n);
    if (!run->guess)
      memset(work->F + own.first, 0, sizeof(double) * (size_t)(own.end - own.first));
    copy_state(run, work, 0);
    for (long long k = 0; k < count; k++) {
      report->t = run->t;
      take_step(run, arrays, work, k > 0 && ends_with_a_kick(), k + 1 < count);
      report->iterations++;
      count_step(run, report, 1);
    }
    if (is_state_finite(run, work->n)) {
      most -= count;
      continue;
    }
    copy_state(run, work, 1);
    *run = before, *report = report_before;
    if (count == 1) {
      report->t = run->t;
      report->iterations++;
      run->guess = 0; /* the stored forces belong to no accepted state */
      return NOT_FINITE;
    }
    together = 1;
  }
  return OK;
}
