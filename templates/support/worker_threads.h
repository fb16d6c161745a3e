/* Worker threads. They are started by a call and joined at its end, so that none exists when a process forks. Requires:
 * indexed_threads.h, MOST_THREADS, is_worth_sharing. */
#ifdef SCVI_THREADS
#include <pthread.h>
#endif

/* The job of all threads, with the same arguments. */
typedef struct job {
  int (*go)(run_memory *run, const struct job *way, solver_report *report);
  const problem *given;
  const solver_options *options;
  double t_end, tolerance;
  long long steps;
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
  const thread_barrier *at = self->run.thread_barrier;
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
  thread_barrier place = {0};
  int status;
  if (wanted < 2 || !is_worth_sharing(run, way->given))
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
static int run_workers(run_memory *run, const job *way, solver_report *report)
{
  return way->go(run, way, report);
}
#endif
