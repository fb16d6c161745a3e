/* Tangent and adjoint vectors over steps that are each solved by Newton's method. Requires: vectors_by_newton.h. */
enum {
  STEPS_AT_ONCE = 1
};

/* Propagates the vectors over step `first`. */
static int propagate_steps(propagation *over, long long first, long long end)
{
  const int status = vectors_by_newton(over, first, 0);
  (void)end;
  over->report->steps += status == OK;
  return status;
}
