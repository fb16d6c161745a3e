/* Preconditioner for Newton-GMRES from the diagonal of F'. Requires: array_newton.h. */

enum { SPARE_VECTORS = 0 }; /* of work */

static void precondition(const linear_system *of, const lanes *x, lanes *y)
{
  apply_inverses(of, x, y, of->own);
}

static void find_inverses(linear_system *of)
{
  find_own_inverses(of);
}

static void choose_preconditioner(linear_system *of, double left)
{
  (void)of, (void)left; /* there is no alternative */
}
