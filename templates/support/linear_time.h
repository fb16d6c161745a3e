/* Time goes on by h. Before it: linearised.h. */

/* How the time at the end depends on that at the start and on h; back: the transpose. */
static void end_time(const linearised_step *at, int back)
{
  flow(back, at->v + GIVEN_H - 1, 1, at->v + GIVEN_H);
}
