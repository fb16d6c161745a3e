/* Mean stencil of h^2 F' / m on a lattice by stencil probing: probes are placed so far apart that their responses do
 * not overlap or reach a boundary, and F' is multiplied by all of them at once. Requires: lattice_transform.h,
 * describe_lattices; FARTHEST, the stencil radius on an axis, and COMPONENTS, the number of components of all
 * lattices. */

enum { SPACING = 2 * FARTHEST + 1 };

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
          find_mean(of, &probe, of->forces, mean);
      }
    if (asked)
      products(of->run, of->given, of->points->X, x, of->forces, of->n); /* begins with a barrier */
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
