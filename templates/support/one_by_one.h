/* Tangent and adjoint vectors over steps that are each solved by Newton's method. Requires: carry_by_newton.h. */
enum {
  STEPS_AT_ONCE = 1
};

/* Propagates the vectors over step `first`. */
static int carry_steps(carriage *over, long long first, long long end)
{
  const int status = carry_by_newton(over, first, 0);
  (void)end;
  over->report->steps += status == OK;
  return status;
}
