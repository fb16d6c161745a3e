#include "array_newton.h"
#include "envelope.h"

/* Preconditioner for Newton-GMRES: factors of F' (envelope.h), Fourier modes (ON_LATTICES), or unless FACTORS_ALONE the
 * diagonal of F'. */
#ifdef ON_LATTICES
/* Fourier preconditioner for Newton-GMRES on lattices: the mean of F' over a lattice, a circulant matrix, which is
 * diagonal in Fourier space (T. F. Chan, SIAM J. Sci. Stat. Comput. 9, 1988, 766). It is accurate if the couplings
 * are uniform and boundaries few; otherwise the diagonal of F' is used. */

enum { SPACING = 2 * FARTHEST + 1 };

#define COUPLED 0.1 /* relative to the diagonal: weaker couplings do not justify the Fourier preconditioner */

/* Describes the lattices and the location of their roots of unity; returns 0 if one cannot be transformed or is too
 * small for stencil probing. */
static int find_lattices(const linear_system *of, lattice *all)
{
  double *next = of->work->roots;
  int sound = 1;
  describe_lattices(of->step->arrays, all);
  for (lattice *one = all; one < all + LATTICES; one++)
    for (int a = 0; a < one->axes; a++) {
      const long long size = one->size[a];
      const roots of_one = {next, next + size, NULL};
      one->of_one[a] = of_one;
      next += 2 * size;
      sound &= can_be_transformed(size) && size >= SPACING * COMPONENTS;
    }
  return sound;
}

/* exp(-2 pi i k / size) for all axes. */
static void find_roots(const linear_system *of, const lattice *all)
{
  for (const lattice *one = all; one < all + LATTICES; one++)
    for (int a = 0; a < one->axes; a++) {
      const long long size = one->size[a];
      const section own = share_of(of->run, size);
      fill_roots(one->of_one[a], size, own.first, own.end);
    }
}

/* Fourier transform along all axes of a lattice of all parts of the state, in place in x; y is overwritten. */
static void transform_lattice(const linear_system *of, const lattice *one, complex_lanes *x, complex_lanes *y)
{
  complex_lanes from = *x, into = *y;
  for (int part = 0; part < X_VECTORS; part++) {
    long long inner = one->components, outer = positions_of(one);
    from = *x, into = *y;
    for (int a = one->axes - 1; a >= 0; a--) {
      axis along = {one->first + part * of->n, outer / one->size[a], one->size[a], inner, one->of_one[a]};
      transform(of->run, &along, &from, &into, X_VECTORS * of->n);
      inner *= one->size[a], outer /= one->size[a];
    }
  }
  *x = from, *y = into;
}

/* The Fourier modes of a lattice that belong to this thread. */
static section modes_of(const linear_system *of, const lattice *one)
{
  section own = share_of(of->run, positions_of(one) * one->components);
  own.first += one->first, own.end += one->first;
  return own;
}

#ifdef CIRCULANT_MODES
/* Finds the lattices and the Fourier modes of their mean Jacobian; returns 0 if a lattice cannot be transformed. */
static int find_modes(linear_system *of, lattice *all)
{
  if (!find_lattices(of, all))
    return 0;
  find_roots(of, all);
  jacobian_modes(of->step, of->points->X, of->work->forces);
  return 1;
}

#ifdef FACTORS_ALONE
/* Numbers of this thread for a coordinate: h times the derivatives -H_qq and H_pp of its Fourier mode. */
static inline double *rates_of_mode(const linear_system *of, long long i)
{
  return of->work->inverse + 2 * i;
}

/* Computes the Fourier modes of the mean of h J H'' without H_qp; returns 0 if a lattice cannot be transformed. */
static int invert_modes(linear_system *of)
{
  lattice all[LATTICES];
  if (!find_modes(of, all))
    return 0;
  for (long long i = of->own.first; i < of->own.end; i++) {
    rates_of_mode(of, i)[0] = mean_derivative(of, of->work->forces, i + of->n);
    rates_of_mode(of, i)[1] = mean_derivative(of, of->work->forces, i);
  }
  wait_at_barrier(of->run);
  return 1;
}

/* Solves x - h A J H'' x = y / places for the modes of this thread, in eigenvectors of A. */
static void apply_inverses_of_modes(const linear_system *of, lanes *x, section own, double places)
{
  const long long apart = X_VECTORS * of->n;
  for (long long i = own.first; i < own.end; i++) {
    const double *rates = rates_of_mode(of, i);
    const complex_shifts mu = {shifts_at(MU), shifts_at(MU + SHIFTS)}, square = product_of(mu, mu);
    const complex_shifts q = into_shifts(x + i, apart, 1.0 / places);
    const complex_shifts p = into_shifts(x + of->n + i, apart, 1.0 / places);
    const complex_shifts from_q = product_of(mu, q), from_p = product_of(mu, p);
    const double both = rates[0] * rates[1];
    const complex_shifts inverse = inverse_of_shifts((complex_shifts){1.0 - both * square.re, -both * square.im});
    const complex_shifts position = {q.re + rates[1] * from_p.re, q.im + rates[1] * from_p.im};
    const complex_shifts momentum = {p.re + rates[0] * from_q.re, p.im + rates[0] * from_q.im};
    from_shifts(product_of(inverse, position), apart, x + i);
    from_shifts(product_of(inverse, momentum), apart, x + of->n + i);
  }
}
#else
/* Computes the inverses of the Fourier modes of the mean of h^2 F' / m; returns 0 if a lattice cannot be transformed.
 */
static int invert_modes(linear_system *of)
{
  lattice all[LATTICES];
  if (!find_modes(of, all))
    return 0;
  for (const lattice *one = all; one < all + LATTICES; one++) {
    const double places = (double)positions_of(one), count = places * (double)one->components;
    const section own = modes_of(of, one);
    double unit = 0.0;
    for (long long i = one->first; (double)(i - one->first) < count; i++)
      unit += unit_of(of->points, i) / count;
    for (long long i = own.first; i < own.end; i++) {
      const double derivative = mean_derivative(of, of->work->forces, i) / unit_of(of->points, i);
      keep_inverse(of, i, unit * derivative, 1.0 / places);
    }
  }
  wait_at_barrier(of->run);
  return 1;
}
#endif
#else
/* Mean stencil of h^2 F' / m on a lattice by stencil probing: probes are placed so far apart that their responses do
 * not overlap or reach a boundary, and F' is multiplied by all of them at once. Requires: lattice_transform.h,
 * describe_lattices; FARTHEST, the stencil radius on an axis, and COMPONENTS, the number of components of all
 * lattices. */

/* Probes: on each axis the first index, their distance and number. */
typedef struct {
  const lattice *one;
  long long first[AXES], apart[AXES], count[AXES], component, all;
} probes;

/* Probes of a component, which is number `turn` of all. */
static probes probes_of(const lattice *one, long long component, long long turn)
{
  probes of = {.one = one, .component = component, .all = 1};
  for (int a = 0; a < one->axes; a++) {
    const int last = a + 1 == one->axes;
    of.first[a] = FARTHEST + (last ? SPACING * turn : 0);
    of.apart[a] = last ? SPACING * COMPONENTS : SPACING;
    of.count[a] = (one->size[a] - FARTHEST - 1 - of.first[a] + of.apart[a]) / of.apart[a];
    of.all *= of.count[a];
  }
  return of;
}

/* Coordinate number `turn` of the box around probe k, and the corresponding coordinate in the stencil of the first
 * place. */
static long long around_probe(const probes *of, long long k, long long turn, long long *in_mean)
{
  long long place = 0, around = 0, apart = of->one->components;
  for (int a = of->one->axes - 1; a >= 0; a--) {
    const long long size = of->one->size[a], offset = turn % SPACING - FARTHEST;
    place += apart * (of->first[a] + k % of->count[a] * of->apart[a] + offset);
    around += apart * ((offset + size) % size);
    apart *= size, k /= of->count[a], turn /= SPACING;
  }
  *in_mean = of->one->first + of->component + around;
  return of->one->first + of->component + place;
}

/* Number of coordinates in a stencil box, in the middle of which is the probe. */
static long long box_of(const lattice *one)
{
  long long size = 1;
  for (int a = 0; a < one->axes; a++)
    size *= SPACING;
  return size;
}

/* Sets x to 1 at the probes. */
static void set_probes(const linear_system *of, const probes *probe, lanes *x)
{
  const long long middle = box_of(probe->one) / 2;
  for (long long k = 0; k < probe->all; k++) {
    long long unused;
    const long long i = around_probe(probe, k, middle, &unused);
    for (int g = 0; g < GROUPS; g++)
      x[g * of->n + i] = lanes_of(1.0);
  }
}

/* Averages the responses h^2 F' / m of the probes into the stencil of the first place of the lattice. */
static void find_mean(const linear_system *of, const probes *probe, const lanes *answer, lanes *mean)
{
  for (long long b = box_of(probe->one) - 1; b >= 0; b--) {
    long long beside = 0;
    double sum = 0.0;
    for (long long k = 0; k < probe->all; k++)
      sum += mean_derivative(of, answer, around_probe(probe, k, b, &beside));
    for (int g = 0; g < GROUPS; g++)
      mean[g * of->n + beside] = lanes_of(sum / (double)probe->all);
  }
}

/* Computes the mean stencils of all lattices in `mean`; x is overwritten. */
static void probe_stencils(linear_system *of, const lattice *all, lanes *x, lanes *mean)
{
  const section own = share_of(of->run, COMPONENTS);
  make_zero(of, x);
  make_zero(of, mean);
  wait_at_barrier(of->run);
  for (int asked = 1; asked >= 0; asked--) {
    long long turn = 0;
    for (const lattice *one = all; one < all + LATTICES; one++)
      for (long long component = 0; component < one->components; component++, turn++) {
        const probes probe = probes_of(one, component, turn);
        if (turn < own.first || turn >= own.end)
          continue;
        if (asked)
          set_probes(of, &probe, x);
        else
          find_mean(of, &probe, of->work->forces, mean);
      }
    if (asked)
      jacobian_times(of->step, of->points->X, x, of->work->forces); /* begins with a barrier */
  }
  wait_at_barrier(of->run);
}

/* Ratio of the off-diagonal part of the stencil to its diagonal: the largest of all components. */
static double off_diagonal_ratio(const linear_system *of, const lattice *all, const lanes *mean)
{
  double largest = 0.0;
  long long turn = 0;
  for (const lattice *one = all; one < all + LATTICES; one++)
    for (long long component = 0; component < one->components; component++, turn++) {
      const probes probe = probes_of(one, component, turn);
      const double own = fabs(at_point(&mean[one->first + component], of->n, 0));
      double sum = -own;
      for (long long b = 0; b < box_of(one); b++) {
        long long beside;
        around_probe(&probe, 0, b, &beside);
        sum += fabs(at_point(&mean[beside], of->n, 0));
      }
      largest = sum > 0.0 ? larger(largest, sum / own) : largest;
    }
  return largest;
}

/* Computes the inverses of the Fourier modes of the mean stencil; returns 0 if a lattice cannot be transformed or
 * couplings are negligible. */
static int invert_modes(linear_system *of)
{
  lattice all[LATTICES];
  if (!find_lattices(of, all))
    return 0;
  find_roots(of, all);
  probe_stencils(of, all, of->work->basis + of->count, of->work->product);
  if (off_diagonal_ratio(of, all, of->work->product) < COUPLED)
    return 0;
  wait_at_barrier(of->run);
  make_zero(of, of->work->forces);
  wait_at_barrier(of->run);
  for (const lattice *one = all; one < all + LATTICES; one++) {
    complex_lanes x = {of->work->product, of->work->forces}, y = {of->work->spare, of->work->spare + of->count};
    section own = modes_of(of, one);
    transform_lattice(of, one, &x, &y);
    for (; own.first < own.end; own.first++)
      keep_inverse(of, own.first, at_point(&x.re[own.first], of->n, 0), 1.0 / (double)positions_of(one));
  }
  wait_at_barrier(of->run);
  return 1;
}
#endif

/* y = the inverses of the Fourier modes times x, by transforms; the result is in the real parts. */
static void apply_modes(const linear_system *of, const lanes *x, lanes *y)
{
  lattice all[LATTICES];
  find_lattices(of, all);
  set_multiple(of, y, 1.0, x);
  make_zero(of, of->work->forces);
  wait_at_barrier(of->run);
  for (const lattice *one = all; one < all + LATTICES; one++) {
    const section own = modes_of(of, one);
    complex_lanes modes = {y, of->work->forces}, spare = {of->work->spare, of->work->spare + of->count}, turned, other;
    transform_lattice(of, one, &modes, &spare);
#ifdef FACTORS_ALONE
    apply_inverses_of_modes(of, modes.re, own, (double)positions_of(one));
    apply_inverses_of_modes(of, modes.im, own, (double)positions_of(one));
#else
    apply_inverses(of, modes.re, modes.re, own);
    apply_inverses(of, modes.im, modes.im, own);
#endif
    wait_at_barrier(of->run);
    turned.re = modes.im, turned.im = modes.re; /* inverse transform: real and imaginary parts exchanged */
    other.re = spare.im, other.im = spare.re;
    transform_lattice(of, one, &turned, &other);
  }
}
#else
#define invert_modes(of) 0
#define apply_modes(of, x, y) (void)0
#endif

static void precondition(const linear_system *of, const lanes *x, lanes *y)
{
  if (of->by_fourier)
    apply_modes(of, x, y);
  else if (of->by_factors)
    apply_factors(of, x, y);
  else
#ifdef FACTORS_ALONE
    set_multiple(of, y, 1.0, x);
#else
    apply_inverses(of, x, y, of->own);
#endif
}

/* Computes the preconditioner, at the first points of a step the Fourier one if coordinates are coupled. */
static void find_inverses(linear_system *of)
{
  if (of->by_factors) {
    find_factors(of);
    return;
  }
  of->by_fourier = (of->tried == 0 || of->by_fourier) && invert_modes(of);
#ifndef FACTORS_ALONE
  if (!of->by_fourier)
    find_own_inverses(of);
#endif
}

/* Called with the reduction of the residual by a cycle: if the Fourier preconditioner did not suffice, tries the
 * diagonal for one cycle, then keeps the better one. */
static void choose_preconditioner(linear_system *of, double left)
{
#ifdef FACTORS_ALONE
  return;
#endif
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
