/* Vectors over steps, each solved by Newton's iteration. Before it: carry_by_newton.h. */
enum {
  STEPS_AT_ONCE = 1
};

/* Over the step `first`. */
static int carry_steps(carriage *over, long long first, long long end)
{
  const int status = carry_by_newton(over, first, 0);
  (void)end;
  over->report->steps += status == OK;
  return status;
}
