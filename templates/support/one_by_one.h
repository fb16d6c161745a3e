/* Vectors over steps, each solved by Newton's iteration. Before it: carry_by_newton.h. */
enum {
  STEPS_OF_PIECE = 1
};

/* Over the step `first`. */
static int carry_piece(carriage *over, long long first, long long end)
{
  const int status = carry_by_newton(over, first, 0);
  (void)end;
  over->report->steps += status == OK;
  return status;
}
