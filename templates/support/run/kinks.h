#include "events.h"

/* Kinks: zeros of u in unit_step(u + mode). A step has one mode, so that its equations are smooth beyond u = 0, too; at
 * the zero of u the side changes and a new part of the step begins. Requires: EVENT_KINKS, FIRST_KINK, MODE_PLACE,
 * PARAMETERS, events.h. */
static int is_kink(int event)
{
#ifdef EVENT_KINKS
  return event >= FIRST_KINK;
#else
  (void)event;
  return 0;
#endif
}

#ifdef EVENT_KINKS
#define KINK_SIDE 0x1p1000 /* beyond all values of u: the sign of u + mode is that of the mode */
#define KINK_PROBE 0x1p-10 /* part of a step after which u has left zero at a start */

/* Sets the side of a kink in the search and in the parameters of its steps. */
static void set_side(const event_step *step, int kink, int side)
{
  step->watch->side[kink] = step->own[MODE_PLACE[kink]] = side * KINK_SIDE;
}

/* The side of u at a state, 0 within the effect of rounding; values: of all functions there. */
static int side_of(const event_step *step, int kink, const real *value)
{
  const int e = EVENT_FIRST[FIRST_KINK + kink];
  const real noise = 8.0 * values_at(step, EVENT_DEGREE + 2)[e];
  return (value[e] > noise) - (value[e] < -noise);
}

/* Sides of all kinks at a state where a run is or starts: by the signs of their functions, within rounding as before.
 * Those that remain 0 follow from the first step. Returns their number in *unknown. */
static int settle_sides(const event_step *step, const event_sample *at, int *unknown)
{
  real *const value = values_at(step, 0);
  int doubtful = 0, status = evaluate_functions(step, at, value);
  *unknown = 0;
  for (int k = 0; status == OK && k < EVENT_KINKS; k++) {
    const real g = value[EVENT_FIRST[FIRST_KINK + k]], side = step->watch->side[k];
    step->watch->acts[FIRST_KINK + k] = 1;
    step->own[MODE_PLACE[k]] = side;
    doubtful |= !((g > 0.0 && side > 0.0) || (g < 0.0 && side < 0.0));
  }
  if (status == OK && doubtful)
    status = rounding_of(step, at);
  for (int k = 0; status == OK && doubtful && k < EVENT_KINKS; k++) {
    const int side = side_of(step, k, value);
    if (side)
      set_side(step, k, side);
    *unknown += step->watch->side[k] == 0.0;
  }
  return status;
}

/* Sides of the kinks at whose zeros a run starts: those after a small part of its first step by the formula. A function
 * that stays within rounding has the side 1, as unit_step(0) = 1. */
static int sides_after_start(event_step *step, const event_sample *at, real length)
{
  event_sample next;
  int status;
  step->t = at->t;
  step->h = length;
  step->q = at->q;
  step->p = at->p;
  status = state_at(step, KINK_PROBE, &next);
  if (status == OK)
    status = evaluate_functions(step, &next, values_at(step, EVENT_DEGREE + 1));
  for (int k = 0; status == OK && k < EVENT_KINKS; k++)
    if (step->watch->side[k] == 0.0)
      set_side(step, k, side_of(step, k, values_at(step, EVENT_DEGREE + 1)) < 0 ? -1 : 1);
  return status;
}

/* Changes to the other side at the crossings from `first` on, which have one state. The motion must leave zero there:
 * if the equations of both sides point to the surface, it slides (A. F. Filippov, Differential Equations with
 * Discontinuous Righthand Sides, 1988). */
static int change_sides(const event_step *step, long long first, const event_sample *at, real length)
{
  event_step after = *step;
  int status = OK, known = 0;
  for (long long i = first; i < *step->filled; i++)
    if (step->found[i].function >= FIRST_KINK)
      set_side(step, step->found[i].function - FIRST_KINK, step->found[i].direction);
  after.t = at->t;
  after.h = length;
  after.q = at->q;
  after.p = at->p;
  for (long long i = first; status == OK && i < *step->filled; i++) {
    const event_crossing *crossing = step->found + i;
    const int e = FUNCTION_OF(crossing);
    real change, doubt;
    if (crossing->function < FIRST_KINK)
      continue;
    if (!known) {
      status = evaluate_functions(&after, at, values_at(step, 0));
      if (status == OK)
        status = rounding_of(&after, at);
    }
    known = 1;
    if (status == OK)
      status = first_change(&after, e, at, values_at(step, EVENT_DEGREE + 2)[e], &change, &doubt);
    if (status == OK && crossing->direction * change < -4.0 * doubt) {
      step->watch->sliding = crossing->function + 1;
      status = NOT_CONVERGED;
    }
  }
  return status;
}
#endif
