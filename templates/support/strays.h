/* Whether what Newton's iteration found is no motion. Before it: stage_error.h, where the stages tell their error. */

#define MOST_ERROR 1.0 /* of a step, relative to the state: beyond it another solution of the equations may be found */
#define NEARLY_LINEAR 8 /* iterations: what so few solve, rounding included, has one solution near, however stiff */

/* Whether stages that solve their equations, after so many iterations, are far from any motion. */
static SELDOM int strays(const step_data *step, const real *z, const real *dq, long long iterations)
{
#ifdef STAGE_POWER
  return iterations > NEARLY_LINEAR && !(MATH(pow)(stage_error(step, z, dq, ALL, DECAY, 0), STAGE_POWER) <= MOST_ERROR);
#else
  (void)step, (void)z, (void)dq, (void)iterations;
  return 0;
#endif
}
