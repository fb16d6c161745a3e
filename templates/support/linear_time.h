/* Linearised time without time transformation: t + h. Requires: linearised.h. */

/* Derivative of the time at the end with respect to that at the start and h; back: its transpose. */
static void end_time(const linearised_step *at, int back)
{
  flow(back, at->v + INPUT_H - 1, 1, at->v + INPUT_H);
}
