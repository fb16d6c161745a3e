/* Fourier preconditioner for Newton-GMRES on lattices: the mean of F' over a lattice, a circulant matrix, which is
 * diagonal in Fourier space (T. F. Chan, SIAM J. Sci. Stat. Comput. 9, 1988, 766). It is accurate if the couplings are
 * uniform and boundaries few; otherwise the diagonal of F' is used. Requires: stencil_probing.h. */

enum { SPARE_VECTORS = 2 }; /* of work */
#define COUPLED 0.1 /* relative to the diagonal: weaker couplings do not justify the Fourier preconditioner */

/* Describes the lattices and the location of their roots of unity; returns 0 if one cannot be transformed or is too
 * small for stencil probing. */
static int find_lattices(const linear_system *of, lattice *all)
{
  double *next = of->roots;
  int sound = 1;
  describe_lattices(of->given, all);
  for (lattice *one = all; one < all + LATTICES; one++)
    for (int a = 0; a < one->axes; a++) {
      const long long size = one->size[a];
      const roots of_one = {next, next + size};
      one->of_one[a] = of_one;
      next += 2 * size;
      sound &= can_be_transformed(size) && size >= SPACING * COMPONENTS;
    }
  return sound;
}

/* exp(-2 pi i k / size) for all axes. */
static void find_roots(const linear_system *of, const lattice *all)
{
  double *next = of->roots;
  for (const lattice *one = all; one < all + LATTICES; one++)
    for (int a = 0; a < one->axes; a++) {
      const long long size = one->size[a];
      const section own = share_of(of->run, size);
      for (long long k = own.first; k < own.end; k++) {
        const double angle = 6.283185307179586 * (double)k / (double)size;
        next[k] = cos(angle);
        next[size + k] = -sin(angle);
      }
      next += 2 * size;
    }
}

/* Fourier transform along all axes of a lattice, in place in x; y is scratch. */
static void transform_lattice(const linear_system *of, const lattice *one, complex_lanes *x, complex_lanes *y)
{
  long long inner = one->components, outer = positions_of(one);
  for (int a = one->axes - 1; a >= 0; a--) {
    axis along = {one->first, outer / one->size[a], one->size[a], inner, one->of_one[a]};
    transform(of->run, &along, x, y, of->n);
    inner *= one->size[a], outer /= one->size[a];
  }
}

/* The Fourier modes of a lattice that belong to this thread. */
static section modes_of(const linear_system *of, const lattice *one)
{
  section own = share_of(of->run, positions_of(one) * one->components);
  own.first += one->first, own.end += one->first;
  return own;
}

/* Computes the inverses of the Fourier modes of the mean stencil; returns 0 if couplings are negligible. */
static int invert_modes(linear_system *of, const lattice *all)
{
  find_roots(of, all);
  probe_stencils(of, all, of->basis + of->count, of->product);
  if (off_diagonal_ratio(of, all, of->product) < COUPLED)
    return 0;
  wait_at_barrier(of->run);
  make_zero(of, of->forces);
  wait_at_barrier(of->run);
  for (const lattice *one = all; one < all + LATTICES; one++) {
    complex_lanes x = {of->product, of->forces}, y = {of->spare, of->spare + of->count};
    section own = modes_of(of, one);
    transform_lattice(of, one, &x, &y);
    for (; own.first < own.end; own.first++)
      keep_inverse(of, own.first, at_point(&x.re[own.first], of->n, 0), 1.0 / (double)positions_of(one));
  }
  wait_at_barrier(of->run);
  return 1;
}

/* Applies the inverses to the Fourier modes of a lattice and transforms back; the result is in the real parts. */
static void apply_modes(const linear_system *of, const lattice *one, complex_lanes x, complex_lanes y)
{
  const section own = modes_of(of, one);
  complex_lanes turned, scratch;
  transform_lattice(of, one, &x, &y);
  apply_inverses(of, x.re, x.re, own);
  apply_inverses(of, x.im, x.im, own);
  wait_at_barrier(of->run);
  turned.re = x.im, turned.im = x.re; /* inverse transform: real and imaginary parts exchanged */
  scratch.re = y.im, scratch.im = y.re;
  transform_lattice(of, one, &turned, &scratch);
}

static void precondition(const linear_system *of, const lanes *x, lanes *y)
{
  lattice all[LATTICES];
  if (!of->by_fourier) {
    apply_inverses(of, x, y, of->own);
    return;
  }
  find_lattices(of, all);
  scale(of, y, 1.0, x);
  make_zero(of, of->forces);
  wait_at_barrier(of->run);
  for (const lattice *one = all; one < all + LATTICES; one++) {
    const complex_lanes both = {y, of->forces}, scratch = {of->spare, of->spare + of->count};
    apply_modes(of, one, both, scratch);
  }
}

/* Computes the preconditioner, at the first points of a step the Fourier one if coordinates are coupled. */
static void find_inverses(linear_system *of)
{
  lattice all[LATTICES];
  if (of->tried == 0)
    of->by_fourier = find_lattices(of, all);
  if (of->by_fourier) {
    find_lattices(of, all);
    of->by_fourier = invert_modes(of, all);
  }
  if (!of->by_fourier)
    find_own_inverses(of);
}

/* Called with the reduction of the residual by a cycle: if the Fourier preconditioner did not suffice, tries the
 * diagonal for one cycle, then keeps the better one. */
static void choose_preconditioner(linear_system *of, double left)
{
  if (of->tried == 0 && of->by_fourier) {
    of->tried = 1, of->left = left;
    of->by_fourier = 0;
    find_inverses(of);
  } else if (of->tried == 1) {
    of->tried = 2;
    of->by_fourier = of->left < left;
    if (of->by_fourier)
      find_inverses(of);
  }
}
