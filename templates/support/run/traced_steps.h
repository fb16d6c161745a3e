#include "contact_steps.h"

/* Steps of a run with contacts by steps that are taken again, with both contact problems of each. */

/* A part of a step by number from (t, q, p) to (q1, p1), as in contact_step. */
typedef struct {
  real number, t, h, q[M], p[M], q1[M], p1[M], part, factor;
  step_solution positions, velocities;
} step_trace;

static step_trace trace_of(const contact_step *in, long long number, const real *p1)
{
  step_trace to = {.number = (real)number, .t = in->t, .h = in->h, .part = in->part, .factor = in->factor};
  copy_state(to.q, to.p, in->q, in->p);
  copy_state(to.q1, to.p1, in->q1, p1);
  to.positions = in->positions;
  to.velocities = in->velocities;
  return to;
}

int NAME(trace_by_steps)(long long steps, const real *t, const real *h, real *q, real *p, int chained,
    real *parameters, int is_strict, long long room, real *traces, long long *filled, solver_report *report,
    real *workspace)
{
  contact_step in;
  event_watch watch;
  event_run run;
  real idle[PARAMETERS], imposed[PARAMETERS];
  memset(report, 0, sizeof *report);
  memset(&in, 0, sizeof in);
  memset(&watch, 0, sizeof watch);
  memset(&run, 0, sizeof run);
  memcpy(idle, parameters, sizeof idle);
  memcpy(imposed, parameters, sizeof imposed);
  put_in_all(CONTACT_IS_OPEN, idle);
  put_in_all(CONTACT_STICKS, imposed);
  in.idle = idle;
  in.imposed = imposed;
  *filled = 0;
  set_run(&run, t[0], &(event_sample){.q = q, .p = p});
  run.h = h[0];
  TRY(find_start(&in, &run, &watch.steps, workspace));
  for (int k = 0; k < EVENT_CONTACTS; k++) { /* modes are those of the run */
    const contact_places *const at = CONTACTS + k;
    note_slip(&in, &watch.steps, k);
    watch.steps.is_closed[k] = at->closed < 0 || parameters[MODE_PLACE[at->closed]] > 0.0;
    watch.steps.sticks[k] = at->slips > 0 && parameters[MODE_PLACE[at->sticks]] > 0.0;
  }
  watch.steps.is_strict = is_strict;
  for (long long k = 0; k < steps && room - *filled >= STEP_PARTS; k++) {
    real q1[M], p1[M];
    report->t = t[k];
    copy_state(q1, p1, q + k * M, p + k * M);
    for (int done = 0; done < STEP_PARTS;) {
      TRY(next_part(&in, &watch.steps, t[k], h[k], q1, p1, &done, workspace));
      ((step_trace *)traces)[(*filled)++] = trace_of(&in, k, p1);
    }
    if (chained)
      copy_state(q + (k + 1) * M, p + (k + 1) * M, q1, p1);
    report->steps++;
  }
  put_memory(&watch.steps, watch.mode);
  put_modes(watch.mode, parameters);
  return OK;
}
