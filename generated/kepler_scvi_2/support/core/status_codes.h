#ifndef SUPPORT_STATUS_CODES_H
#define SUPPORT_STATUS_CODES_H

/* Status codes and report of a step. Requires: the integrator's header, NAME, STATUS. */
enum {
  OK = STATUS(OK),
  NOT_CONVERGED = STATUS(NOT_CONVERGED),
  SINGULAR = STATUS(SINGULAR),
  NOT_FINITE = STATUS(NOT_FINITE)
};

typedef NAME(options) solver_options;
typedef NAME(report) solver_report;

#endif
