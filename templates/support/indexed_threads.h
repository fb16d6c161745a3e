/* Threads that share the steps of a run. Each goes the whole way with a copy of its own of all that is no array, and
 * does its part of every loop; where one reads what others wrote, they wait for each other. They live as long as a
 * call: nothing is left behind, not even where a process is forked. Without SCVI_THREADS the caller's thread goes
 * alone. Before it: indexed.h, MOST_THREADS. */
#ifdef SCVI_THREADS
#include <pthread.h>
#include <sched.h>
#endif

enum { BLOCKS = 64 }; /* of coordinates at most, in which sums are made */

/* Where they wait: who came in this round; two tables of sums of blocks, used in turn. */
typedef struct {
  long long threads;
  int arrived, round;
  double sums[2][2][BLOCKS];
} meeting;

/* What all do, with the same arguments. */
typedef struct travel {
  int (*go)(run_memory *run, const struct travel *way, solver_report *report);
  const problem *given;
  const solver_options *options;
  double t_end, tolerance;
  long long steps;
} travel;

static inline long long threads_of(const run_memory *run)
{
  const meeting *at = run->meeting;
  return at ? at->threads : 1;
}

#ifdef SCVI_THREADS
#define SPINS 4000 /* looks, some microseconds, until others may have the processor */

/* Until all of them are here. What they wrote before is seen after. */
static void wait_for_others(const run_memory *run)
{
  meeting *at = run->meeting;
  int round;
  if (!at)
    return;
  round = __atomic_load_n(&at->round, __ATOMIC_RELAXED);
  if (__atomic_add_fetch(&at->arrived, 1, __ATOMIC_ACQ_REL) == at->threads) {
    __atomic_store_n(&at->arrived, 0, __ATOMIC_RELAXED);
    __atomic_store_n(&at->round, round + 1, __ATOMIC_RELEASE);
    return;
  }
  for (int looks = 0; __atomic_load_n(&at->round, __ATOMIC_ACQUIRE) == round; looks++)
    if (looks > SPINS)
      sched_yield();
}

typedef struct {
  run_memory run;
  const travel *way;
  solver_report report;
  pthread_t thread;
} companion;

/* Waits until it is known how many they are. */
static void *accompany(void *one)
{
  companion *self = one;
  const meeting *at = self->run.meeting;
  while (__atomic_load_n(&at->threads, __ATOMIC_ACQUIRE) == 0)
    sched_yield();
  self->way->go(&self->run, self->way, &self->report);
  return NULL;
}

/* The same way by as many threads as the run asks for, or as there can be. */
static int go_together(run_memory *run, const travel *way, solver_report *report)
{
  companion others[MOST_THREADS];
  const long long wanted = run->threads < MOST_THREADS ? run->threads : MOST_THREADS;
  long long threads = 1;
  meeting place = {0};
  int status;
  if (wanted < 2)
    return way->go(run, way, report);
  run->meeting = &place;
  run->part = 0;
  for (; threads < wanted; threads++) {
    companion *next = &others[threads];
    next->run = *run, next->report = *report, next->way = way;
    next->run.part = threads;
    if (pthread_create(&next->thread, NULL, accompany, next) != 0)
      break;
  }
  __atomic_store_n(&place.threads, threads, __ATOMIC_RELEASE);
  status = way->go(run, way, report);
  while (--threads > 0)
    pthread_join(others[threads].thread, NULL);
  run->meeting = NULL;
  return status;
}
#else
static inline void wait_for_others(const run_memory *run)
{
  (void)run;
}

static int go_together(run_memory *run, const travel *way, solver_report *report)
{
  return way->go(run, way, report);
}
#endif
