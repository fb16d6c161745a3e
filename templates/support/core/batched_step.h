#ifndef SUPPORT_BATCHED_STEP_H
#define SUPPORT_BATCHED_STEP_H

#include "vectors.h"

/* Arguments and report of a batched step. Requires: the header, NAME, STATUS, vectors.h. */
enum {
  OK = STATUS(OK),
  NOT_FINITE = STATUS(FAILED)
};

typedef NAME(options) solver_options;
typedef NAME(block) block_memory;

/* Which trajectories the iteration still serves, and the number of iterations. */
typedef struct {
  double *active;
  long long iterations;
} solver_report;

/* Arguments of a step. */
typedef struct {
  double t, h;
  const lanes *q0, *p0, *carry_q, *carry_p, *parameters;
} step_data;

/* Range of coordinates. */
typedef struct {
  long long first, end;
} section;

#endif
