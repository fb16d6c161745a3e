#include "../core/status_codes.h"
#include "../core/step.h"

/* Flow of many steps as one function, from (q, p, parameters, t, h) to the states (q, p) at the start and after every
 * `every` steps, with JVPs and VJPs along it. Requires: run.h, jvp_and_vjp.h. */
#include <stdlib.h>

#define FLOW_SAME_STATE 1e-6 /* relative to the largest number of this state and the previous one: a spurious solution
                              * is farther away */

enum {
  FLOW_STATE = 2 * M,
  FLOW_CHUNK = 64, /* steps per chunk, for whose vectors there is memory */
  FLOW_NO_MEMORY = 6
};

/* Results of a flow: states; tangent vectors of the states (JVP); gradients with respect to the inputs (VJP); their
 * derivatives along tangent vectors of the inputs. */
typedef enum {
  FLOW_STATES,
  FLOW_JVP,
  FLOW_VJP,
  FLOW_HESSIAN
} flow_part;

/* Parameters of the evaluation of a row, and its memory. */
typedef struct {
  long long steps, every;
  int count; /* tangent or adjoint vectors at a time */
  real *states; /* (steps + 1, FLOW_STATE) */
  real *t, *h, *q, *p, *q1, *p1; /* of the steps of a chunk */
  real *vectors; /* (FLOW_CHUNK + 1, count, STEP_INPUTS) */
  real *room; /* of second derivatives: (steps + 1, count, STEP_INPUTS) tangent vectors, (FLOW_CHUNK + 1, 2, count,
               * STEP_INPUTS) adjoint vectors with their derivatives */
  real *workspace;
} flow_call;

/* Numbers of all vectors of inputs. */
static long long numbers_across(const flow_call *way)
{
  return (long long)way->count * STEP_INPUTS;
}

/* Allocates the memory, to be freed at way->workspace; returns 0 if there is none. Intermediate states are stored only
 * for derivatives. */
static int allocate_flow(flow_part part, flow_call *way)
{
  const size_t work = STATUS(LINEARISED_WORKSPACE), piece = (size_t)FLOW_CHUNK * (2 + 4 * M);
  const size_t vectors = (size_t)(FLOW_CHUNK + 1) * (size_t)way->count * STEP_INPUTS;
  const size_t states = way->count ? ((size_t)way->steps + 1) * FLOW_STATE : 0;
  const size_t room = part == FLOW_HESSIAN ? (size_t)(way->steps + 1 + 2 * (FLOW_CHUNK + 1)) : 0;
  real *place = malloc(sizeof(real) * (work + piece + vectors + states + room * (size_t)numbers_across(way)));
  way->workspace = place;
  way->t = place + work;
  way->h = way->t + FLOW_CHUNK;
  way->q = way->h + FLOW_CHUNK;
  way->p = way->q + FLOW_CHUNK * M;
  way->q1 = way->p + FLOW_CHUNK * M;
  way->p1 = way->q1 + FLOW_CHUNK * M;
  way->vectors = way->p1 + FLOW_CHUNK * M;
  way->states = way->vectors + vectors;
  way->room = way->states + states;
  return place != NULL;
}

/* Computes the states after every `every` steps from x, starting with x itself. On failure returns the status of the
 * step, and report->steps is the number of completed ones. */
static int follow(const flow_call *way, const real *x, long long every, real *states, solver_report *report)
{
  run_memory run;
  NAME(start)(&run, x[INPUT_H - 1], x[INPUT_H], x, x + M);
  memcpy(states, x, sizeof(real) * FLOW_STATE);
  for (long long done = 0; done < way->steps; done += every) {
    int iterations, status;
    real t;
    states += FLOW_STATE;
    status = NAME(advance)(&run, every, every, x + FLOW_STATE, NULL, &t, states, states + M, &iterations, report,
        way->workspace);
    if (status != OK) {
      report->steps += done;
      return status;
    }
  }
  return OK;
}

/* Index of the first step of a chunk whose recomputation does not reproduce its end, or the number of steps. */
static int first_mismatch(const flow_call *way, const real *states, int length)
{
  for (int k = 0; k < length; k++, states += FLOW_STATE) {
    real off[FLOW_STATE];
    for (int i = 0; i < M; i++) {
      off[i] = way->q1[k * M + i] - states[FLOW_STATE + i];
      off[M + i] = way->p1[k * M + i] - states[FLOW_STATE + M + i];
    }
    if (!(largest_magnitude(off, FLOW_STATE) <= FLOW_SAME_STATE * largest_magnitude(states, 2 * FLOW_STATE)))
      return k;
  }
  return length;
}

/* Number of steps of the chunk after those done. */
static int chunk_size_after(const flow_call *way, long long done)
{
  return (int)(way->steps - done < FLOW_CHUNK ? way->steps - done : FLOW_CHUNK);
}

/* Fills in the start states of the steps of a chunk. */
static void fill_chunk(const flow_call *way, const real *x, long long done, int length)
{
  const real *states = way->states + done * FLOW_STATE;
  for (int k = 0; k < length; k++) {
    way->t[k] = x[INPUT_H - 1] + (real)(done + k) * x[INPUT_H];
    way->h[k] = x[INPUT_H];
    memcpy(way->q + k * M, states + k * FLOW_STATE, sizeof(real) * M);
    memcpy(way->p + k * M, states + k * FLOW_STATE + M, sizeof(real) * M);
  }
}

/* Propagates the vectors over a chunk of steps; SPURIOUS_SOLUTION if a recomputed step differs. */
static int propagate_chunk_of_steps(const flow_call *way, const real *x, long long done, int length, int back,
    solver_report *report)
{
  fill_chunk(way, x, done, length);
  const int status = NAME(linearise)(length, way->t, way->h, way->q, way->p, x + FLOW_STATE, NULL, back, way->count,
      way->vectors, way->q1, way->p1, report, way->workspace);
  if (status != OK) {
    report->steps = back ? done + length - 1 - report->steps : done + report->steps;
    return status;
  }
  const int mismatch = first_mismatch(way, way->states + done * FLOW_STATE, length);
  if (mismatch == length)
    return OK;
  report->steps = done + mismatch;
  report->t = way->t[mismatch];
  return STATUS(SPURIOUS_SOLUTION);
}

/* Offset of the state at the end of a step in an array (count, kept states, FLOW_STATE) for vector c; -1 if that state
 * is not stored. */
static long long state_offset(const flow_call *way, long long step, int c)
{
  return step % way->every ? -1 : (c * (way->steps / way->every + 1) + step / way->every) * FLOW_STATE;
}

static void store_tangents(const flow_call *way, long long step, const real *vectors, real *changes)
{
  for (int c = 0; c < way->count; c++)
    if (state_offset(way, step, c) >= 0)
      memcpy(changes + state_offset(way, step, c), vectors + c * STEP_INPUTS, sizeof(real) * FLOW_STATE);
}

static void add_adjoints(const flow_call *way, long long step, const real *partials, real *vectors)
{
  for (int c = 0; c < way->count; c++)
    for (int i = 0; i < FLOW_STATE && state_offset(way, step, c) >= 0; i++)
      vectors[c * STEP_INPUTS + i] += partials[state_offset(way, step, c) + i];
}

/* From (count, STEP_INPUTS) tangent vectors of the inputs to (count, kept states, FLOW_STATE) tangent vectors of the
 * states. */
static int jvp_along(const flow_call *way, const real *x, const real *changes, real *kept, solver_report *report)
{
  const long long across = numbers_across(way);
  int length = 0;
  memcpy(way->vectors, changes, sizeof(real) * (size_t)across);
  store_tangents(way, 0, way->vectors, kept);
  for (long long done = 0; done < way->steps; done += length) {
    length = chunk_size_after(way, done);
    memset(way->vectors + across, 0, sizeof(real) * (size_t)(across * length));
    TRY(propagate_chunk_of_steps(way, x, done, length, 0, report));
    for (int k = 1; k <= length; k++)
      store_tangents(way, done + k, way->vectors + k * across, kept);
    memcpy(way->vectors, way->vectors + length * across, sizeof(real) * (size_t)across);
  }
  return OK;
}

/* From (count, kept states, FLOW_STATE) adjoint vectors of the states to (count, STEP_INPUTS) gradients with respect
 * to the inputs. */
static int vjp_along(const flow_call *way, const real *x, const real *kept, real *partials, solver_report *report)
{
  const long long across = numbers_across(way);
  int length = 0;
  memset(way->vectors, 0, sizeof(real) * (size_t)across);
  for (long long end = way->steps; end > 0; end -= length) {
    length = chunk_size_after(way, way->steps - end);
    memcpy(way->vectors + length * across, way->vectors, sizeof(real) * (size_t)across);
    memset(way->vectors, 0, sizeof(real) * (size_t)(across * length));
    for (int k = 1; k <= length; k++)
      add_adjoints(way, end - length + k, kept, way->vectors + k * across);
    TRY(propagate_chunk_of_steps(way, x, end - length, length, 1, report));
  }
  add_adjoints(way, 0, kept, way->vectors);
  memcpy(partials, way->vectors, sizeof(real) * (size_t)across);
  return OK;
}

#ifdef SECOND_DERIVATIVES
/* Second derivatives of a flow: tangent vectors of its VJP. Requires: second_derivatives.h. */

/* Computes from (count, kept states, FLOW_STATE) adjoint vectors, each with one of (count, STEP_INPUTS) tangent
 * vectors of the inputs, the (count, STEP_INPUTS) derivatives of the gradients along them. */
static int hessian_along(const flow_call *way, const real *x, const real *kept, const real *changes, real *found,
    solver_report *report)
{
  const long long across = numbers_across(way);
  real *room = way->room, *partials = room + (way->steps + 1) * across;
  int length = 0;
  memset(room, 0, sizeof(real) * (size_t)((way->steps + 1 + 2 * (FLOW_CHUNK + 1)) * across));
  memcpy(room, changes, sizeof(real) * (size_t)across);
  for (long long done = 0; done < way->steps; done += length) {
    flow_call here = *way;
    here.vectors = room + done * across;
    length = chunk_size_after(way, done);
    TRY(propagate_chunk_of_steps(&here, x, done, length, 0, report));
  }
  for (long long end = way->steps; end > 0; end -= length) {
    length = chunk_size_after(way, way->steps - end);
    memcpy(partials + 2 * length * across, partials, sizeof(real) * (size_t)(2 * across));
    memset(partials, 0, sizeof(real) * (size_t)(2 * across * length));
    for (int k = 1; k <= length; k++)
      add_adjoints(way, end - length + k, kept, partials + 2 * k * across);
    fill_chunk(way, x, end - length, length);
    const int status = NAME(second_order)(length, way->t, way->h, way->q, way->p, x + FLOW_STATE, NULL, way->count,
        room + (end - length) * across, partials, report, way->workspace);
    if (status != OK) {
      report->steps = end - 1 - report->steps;
      return status;
    }
  }
  memcpy(found, partials + across, sizeof(real) * (size_t)across);
  return OK;
}
#endif

/* Evaluates the flow or its derivatives for a row of inputs; given: tangent or adjoint vectors. */
static int flow_row(flow_part part, const flow_call *way, const real *x, const real *given, const real *changes,
    real *found, solver_report *report)
{
  if (part == FLOW_STATES)
    return follow(way, x, way->every, found, report);
  TRY(follow(way, x, 1, way->states, report));
  if (part == FLOW_JVP)
    return jvp_along(way, x, given, found, report);
#ifdef SECOND_DERIVATIVES
  if (part == FLOW_HESSIAN)
    return hessian_along(way, x, given, changes, found, report);
#endif
  return vjp_along(way, x, given, found, report);
}

/* The same for each of `rows` rows x of STEP_INPUTS inputs; NULL for what a part does not depend on. On failure returns
 * the status of the failed step, or FLOW_NO_MEMORY; later results are undefined. */
static int flow_rows(flow_part part, flow_call *way, long long rows, const real *x, const real *given,
    const real *changes, real *found, solver_report *report)
{
  const long long states = (way->steps / way->every + 1) * FLOW_STATE, values = way->count * states;
  const long long across = numbers_across(way), directions = part == FLOW_JVP ? across : values;
  const long long results[] = {states, values, across, across};
  int status = OK;
  memset(report, 0, sizeof *report);
  if (!allocate_flow(part, way))
    return FLOW_NO_MEMORY;
  for (long long row = 0; row < rows && status == OK; row++)
    status = flow_row(part, way, x + row * STEP_INPUTS, given ? given + row * directions : NULL,
        changes ? changes + row * across : NULL, found + row * results[part], report);
  free(way->workspace);
  return status;
}

#ifdef FLOW_OF_ROWS
/* Flow of many rows, for callers with arrays. part: 0 states, 1 tangent vectors of the states (JVP), 2 gradients with
 * respect to the inputs (VJP); of rows x (rows, STEP_INPUTS), each with `count` tangent vectors, (STEP_INPUTS), or
 * adjoint vectors, (kept states, FLOW_STATE). On failure the results are undefined. */
int NAME(flow_rows)(int part, long long steps, long long every, int count, long long rows, const real *x,
    const real *given, real *found, solver_report *report)
{
  flow_call way = {.steps = steps, .every = every, .count = count};
  return flow_rows((flow_part)part, &way, rows, x, given, NULL, found, report);
}

#ifdef SECOND_DERIVATIVES
/* Derivatives of gradients, (rows, count, STEP_INPUTS). */
int NAME(hessian_rows)(long long steps, long long every, int count, long long rows, const real *x, const real *partials,
    const real *changes, real *found, solver_report *report)
{
  flow_call way = {.steps = steps, .every = every, .count = count};
  return flow_rows(FLOW_HESSIAN, &way, rows, x, partials, changes, found, report);
}
#endif
#endif
