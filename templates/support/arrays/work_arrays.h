#include "../core/points.h"
#include "arrays.h"

/* Workspace of steps that are solved by iteration: the arrays in the memory `work` of a run. Requires: X_VECTORS,
 * F_VECTORS; with ON_LATTICES AXES. */

enum { BASIS = 16 }; /* basis vectors of GMRES before a restart */

typedef struct work_arrays {
  long long n; /* coordinates */
  lanes *X, *F[3]; /* at the points: state; forces of this step and of two former ones, which take turns */
#ifdef NEWTON_KRYLOV
  lanes *residual, *correction, *product, *forces, *inverse, *basis;
#endif
#ifdef ON_LATTICES
  lanes *spare; /* real and imaginary parts */
  double *roots; /* of unity, for all axes */
#endif
  double *inverse_size, *dq, *dp; /* sizes of coordinates; increments, low words behind those of q */
  double *own_q, *own_p, *nothing, *q, *p, *moved, *changes; /* comparison with parts of a step */
  double *last, *last_two; /* parts before its end */
} work_arrays;

static void *next_array(double **rest, long long count)
{
  *rest += count;
  return *rest - count;
}

/* Sets all arrays for n coordinates. */
static work_arrays bind_work_arrays(const run_memory *run, long long n)
{
  work_arrays of = {.n = n};
  double *rest = run->work;
  double **const vectors[] = {&of.inverse_size, &of.own_p, &of.nothing, &of.q, &of.p, &of.moved,
      &of.changes, &of.last, &of.last_two, &of.dp};
  of.X = next_array(&rest, X_VECTORS * POINTS * n);
  for (int k = 0; k < 3; k++)
    of.F[k] = next_array(&rest, F_VECTORS * POINTS * n);
#ifdef NEWTON_KRYLOV
  lanes **const products[] = {&of.residual, &of.correction, &of.product, &of.forces};
  for (int k = 0; k < 4; k++)
    *products[k] = next_array(&rest, X_VECTORS * POINTS * n);
  of.inverse = next_array(&rest, POINTS * POINTS * n);
  of.basis = next_array(&rest, X_VECTORS * (BASIS + 1) * POINTS * n);
#endif
#ifdef ON_LATTICES
  of.spare = next_array(&rest, 2 * X_VECTORS * POINTS * n);
  of.roots = next_array(&rest, 2 * AXES * n);
#endif
  for (size_t k = 0; k < sizeof vectors / sizeof *vectors; k++)
    *vectors[k] = next_array(&rest, n);
  of.own_q = next_array(&rest, 2 * n);
  of.dq = next_array(&rest, 2 * n);
  return of;
}
