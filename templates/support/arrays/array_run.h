#include "../core/step.h"
#include "array_memory.h"
#include "arrays.h"

/* Worker threads. They are started by a call and joined at its end, so that none exists when a process forks. Requires:
 * MOST_THREADS, is_worth_sharing. */
#ifdef SCVI_THREADS
#include <pthread.h>
#endif

/* The job of all threads, with the same arguments. */
typedef struct job {
  int (*go)(run_memory *run, const struct job *way, solver_report *report);
  const problem *arrays;
  const solver_options *options;
  double t_end;
  const step_control *control; /* of adaptive steps; NULL: fixed steps */
  long long steps, every; /* at most; between stored states, if t is not NULL */
  double *t, *q, *p;
  int *iterations;
} job;

#ifdef SCVI_THREADS
typedef struct {
  run_memory run;
  const job *way;
  solver_report report;
  pthread_t thread;
} worker;

/* Starts the job when the number of threads is known. */
static void *run_worker(void *one)
{
  worker *self = one;
  const barrier *at = self->run.thread_barrier;
  while (__atomic_load_n(&at->threads, __ATOMIC_ACQUIRE) == 0)
    sched_yield();
  self->way->go(&self->run, self->way, &self->report);
  return NULL;
}

/* Runs the job with as many threads as the run requests, or as many as can be started; returns its status. */
static int run_workers(run_memory *run, const job *way, solver_report *report)
{
  worker others[MOST_THREADS];
  const long long wanted = run->threads < MOST_THREADS ? run->threads : MOST_THREADS;
  long long threads = 1;
  barrier place = {0};
  int status;
  if (wanted < 2 || !is_worth_sharing(run, way->arrays))
    return way->go(run, way, report);
  run->thread_barrier = &place;
  run->part = 0;
  for (; threads < wanted; threads++) {
    worker *next = &others[threads];
    next->run = *run, next->report = *report, next->way = way;
    next->run.part = threads;
    if (pthread_create(&next->thread, NULL, run_worker, next) != 0)
      break;
  }
  __atomic_store_n(&place.threads, threads, __ATOMIC_RELEASE);
  status = way->go(run, way, report);
  while (--threads > 0)
    pthread_join(others[threads].thread, NULL);
  run->thread_barrier = NULL;
  return status;
}
#else
#define run_workers(run, way, report) (way)->go(run, way, report)
#endif

/* Runs of array systems. Requires: bind_work_arrays, perform_step of a solver, or perform_steps and TOGETHER,
 * ERROR_POWER; with CONSTRAINTS_OF_ARRAYS project_run. */

/* Stores the state after a step if its number is a multiple of `every`, and at the end of an adaptive run; each thread
 * its own coordinates. */
static void store_state(run_memory *run, const job *way, solver_report *report, long long n, int arrived)
{
  const section own = mine(run, n);
  const size_t size = sizeof(double) * (size_t)(own.end - own.first);
  const long long row = report->stored, first = row * n + own.first;
  if (!way->t || (run->step % way->every != 0 && !arrived))
    return;
  memcpy(way->q + first, run->q + own.first, size);
  memcpy(way->p + first, run->p + own.first, size);
  if (run->part == 0) {
    way->t[row] = run->t;
    way->iterations[row] = (int)run->iterations;
  }
  run->iterations = 0;
  report->stored++;
}

#ifndef TOGETHER
/* Performs `most` steps one by one. */
static int perform_steps(run_memory *run, const problem *arrays, const work_arrays *work, const solver_options *options,
    solver_report *report, long long most)
{
  for (long long k = 0; k < most; k++) {
    const long long before = report->iterations;
    report->t = run->t;
    TRY(perform_step(run, arrays, work, options, report));
    count_step(run, report, report->iterations - before);
  }
  return OK;
}
#endif

#ifdef HEAT_BATH
#include "array_bath.h"
#define PERFORM perform_in_bath
#else
#define PERFORM perform_steps
#endif

static int take_steps(run_memory *run, const job *way, solver_report *report)
{
  const work_arrays work = bind_work_arrays(run, coordinates_of(way->arrays));
  while (report->steps < way->steps) {
    const long long left = way->steps - report->steps;
    const long long next = way->t ? way->every - run->step % way->every : left;
    TRY(PERFORM(run, way->arrays, &work, way->options, report, next < left ? next : left));
    store_state(run, way, report, work.n, 0);
  }
  return OK;
}

/* Performs the job with these parameters. Where they are new, rates of constraints may jump, positions may not. */
static int perform(run_memory *run, job way, const double *parameters, const solver_options *options,
    solver_report *report)
{
  solver_report unread;
  report = report ? report : &unread;
  memset(report, 0, sizeof *report);
  report->t = run->t;
  TRY(cannot_store(way.t, way.every) ? STATUS(EVERY_BELOW_1) : OK);
  TRY(use_parameters(run, parameters));
#ifdef HEAT_BATH
  TRY(prepare_bath(run) ? OK : NOT_FINITE);
#endif
  way.arrays = &run->data;
  way.options = options || way.control ? options : &STANDARD_OPTIONS;
#ifdef CONSTRAINTS_OF_ARRAYS
  if (run->is_changed)
    project_run(run, report, 0);
  memset(report, 0, sizeof *report);
#endif
  run->is_changed = 0;
  return run_workers(run, &way, report);
}

int NAME(advance)(run_memory *run, long long steps, long long every, const double *parameters,
    const solver_options *options, double *t, double *q, double *p, int *iterations, solver_report *report,
    double *workspace)
{
  const job way = {.go = take_steps, .steps = steps, .every = every, .t = t, .q = q, .p = p, .iterations = iterations};
  return perform(run, way, parameters, options, report);
}

int NAME(step)(double t, double h, const double *q0, const double *p0, const double *parameters,
    const solver_options *options, double *q1, double *p1, solver_report *report, double *workspace)
{
  run_memory *run = run_in(workspace);
  const size_t size = sizeof(double) * (size_t)coordinates_of(&run->data);
  int status;
  NAME(start)(run, t, h, q0, p0);
  run->error = INFINITY; /* not estimated */
  status = NAME(advance)(run, 1, 1, parameters, options, NULL, NULL, NULL, NULL, report, NULL);
  memcpy(q1, run->q, size);
  memcpy(p1, run->p, size);
  return status;
}

#ifdef NO_ERROR_ESTIMATE
double NAME(step_error)(const run_memory *run)
{
  return NAN;
}
#endif
