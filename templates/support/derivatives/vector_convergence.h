#include "../iteration/convergence.h"

/* Convergence criterion for the fixed-point iterations of tangent and adjoint vectors, and their dependence on
 * parameters and time. Requires: POINT_INPUTS. */

enum { INPUT_T = STEP_INPUTS - 2,
  VECTORS_AT_ONCE = 3 }; /* which are iterated together, so that no product waits for the last one */

#define MOVED_BY_ROUNDING (4.0 * DBL_EPSILON * DBL_EPSILON) /* squared: relative change that rounding alone may cause */

#define LEAST_SIZE 1e-250 /* squared size below which vectors underflow */

/* Squared relative changes of the last two iterations; infinite if there were none. */
typedef struct {
  double last, before, accepted; /* accepted: change still to come */
} vector_changes;

/* Returns 1 if the iteration has converged after a change `moved` of vectors of size `size` (both squared), 0 if it
 * must continue, -1 if it does not converge or the squares overflow or underflow. Convergence is tested from iteration
 * *look on: one before the last iteration of the previous call, since successive steps of a run are similar. */
static inline int vectors_status(double moved, double size, vector_changes *past, int k, int *look)
{
  const double last = past->last, before = past->before, relative = size > 0.0 ? moved / size : moved;
  const int first = !(last < INFINITY), finite = size < INFINITY && (size > LEAST_SIZE || moved == 0.0);
  const int small = relative <= (first ? fmax(MOVED_BY_ROUNDING, past->accepted) : past->accepted);
  const int last_but_one = !first && relative * relative <= past->accepted * last &&
      relative * SUDDEN_CONVERGENCE * last <= past->accepted * before;
  const int stopped = !first && relative >= last &&
      (relative < CERTAIN_ROUNDING || (relative < ROUNDING_LEVEL && relative >= STAGNATION * before));
  const int shrinks = first || relative < 0.5 * last || relative < STAGNATION * before || relative < PROGRESS_LEVEL;
  past->before = last;
  past->last = relative;
  if (finite && (small || last_but_one || stopped)) {
    *look = k - 1;
    return 1;
  }
  return finite && relative < INFINITY && k < MAX_ITERATIONS && shrinks ? 0 : -1;
}

/* Replaces the squared change and size of vectors by those of others that changed more. */
static inline void keep_largest(double moved, double size, double *largest)
{
  if (!(moved * largest[1] < largest[0] * size))
    largest[0] = moved, largest[1] = size;
}

/* Variations of the results of kernels at fixed points, `results` at each, by those of parameters and time. */
static inline void vary_by_inputs(lanes (*given)[INPUT_DERIVATIVES], const double *v, lanes *F, int results)
{
  memset(F, 0, sizeof(lanes) * (size_t)(GROUPS * results));
  for (int n = 0; n < GROUPS; n++)
    for (int e = 0; e < INPUT_DERIVATIVES; e++) {
      const int from = 2 * M + POINT_INPUTS[e][1];
      const lanes by = from == INPUT_T ? v[INPUT_T] + v[INPUT_T + 1] * ABSCISSA[n] : lanes_of(v[from]);
      F[n * results + POINT_INPUTS[e][0]] += given[n][e] * by;
    }
}

/* Adds to v the gradient with respect to parameters and time from the adjoint variables of the results in u, with
 * `stride` numbers per group. */
static inline void add_input_gradient(lanes (*given)[INPUT_DERIVATIVES], const lanes *u, int stride, double *v)
{
  lanes by[STEP_INPUTS - 2 * M][GROUPS];
  memset(by, 0, sizeof by);
  for (int n = 0; n < GROUPS; n++)
    for (int e = 0; e < INPUT_DERIVATIVES; e++) {
      const int to = POINT_INPUTS[e][1];
      const lanes part = given[n][e] * u[n * stride + POINT_INPUTS[e][0]];
      by[to][n] += part;
      if (to == INPUT_T - 2 * M)
        by[to + 1][n] += ABSCISSA[n] * part;
    }
  for (int j = 0; j < STEP_INPUTS - 2 * M; j++)
    v[2 * M + j] += points_total(by[j]);
}
