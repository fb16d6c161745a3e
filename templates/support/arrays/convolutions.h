#include "circulant.h"

/* Convolutions of arrays of the state, their derivatives and the energies that depend on them. Requires: CONVOLUTIONS,
 * KINDS, STATES; MOST_STAGES, the largest number of circulant matrices of a convolution. */

/* Values of all convolutions of a state and of a direction, and derivatives with respect to them, at a group of points;
 * `length` numbers each. */
typedef struct {
  const lanes *values, *along;
  lanes *transposed;
  long long length;
} images;

/* Convolution number `number`: products with circulant matrices, one after the other. Derivatives with respect to those
 * with target = 1 are added to the forces. */
typedef struct {
  int number, target, count;
  circulant stages[MOST_STAGES];
} convolution;

static void describe_convolutions(const problem *arrays, convolution *all);

/* The values of a state are vector 0, derivatives vector 1, values of a direction vector 2. */
static lanes *sums_at(const transforms *in, int vector, int group)
{
  return in->sums + (vector * GROUPS + group) * KINDS * STATES * in->count;
}

static images images_at(const transforms *in, int group)
{
  return (images){sums_at(in, 0, group), sums_at(in, 2, group), sums_at(in, 1, group), STATES * in->count};
}

static void multiply_by_circulant(const transforms *in, const circulant *by, double turn, const lanes *X,
    long long apart, const lanes *factor, lanes *Y, long long behind)
{
  const plan of = shared_plan(in, by);
  multiply_by_plan(in, by, &of, turn, X, apart, factor, Y, behind);
}

/* Computes all convolutions of x, whose groups are `apart` numbers apart, for a vector. */
static void find_sums(const transforms *in, const problem *arrays, int vector, const lanes *x, long long apart)
{
  const long long length = STATES * in->count;
  convolution all[CONVOLUTIONS];
  describe_convolutions(arrays, all);
  for (const convolution *one = all; one < all + CONVOLUTIONS; one++) {
    lanes *into = sums_at(in, vector, 0) + one->number * length;
    for (int k = 0; k < one->count; k++)
      multiply_by_circulant(in, &one->stages[k], 1.0, k ? into : x, k ? KINDS * length : apart, NULL, into,
          KINDS * length);
  }
}

/* Sets the derivatives to 0, each thread its own part. */
static void clear_transposed(const transforms *in)
{
  const section own = share_of(in->run, KINDS * STATES * in->count);
  for (int group = 0; group < GROUPS; group++)
    memset(sums_at(in, 1, group) + own.first, 0, sizeof(lanes) * (size_t)(own.end - own.first));
  wait_at_barrier(in->run);
}

/* Adds the transposed convolutions of the derivatives to F, whose groups are n numbers apart. */
static void add_transposed(const transforms *in, const problem *arrays, lanes *F, long long n)
{
  const long long length = STATES * in->count;
  lanes factor[GROUPS];
  convolution all[CONVOLUTIONS];
  describe_convolutions(arrays, all);
  for (int group = 0; group < GROUPS; group++)
    factor[group] = lanes_of(1.0);
  for (const convolution *one = all; one < all + CONVOLUTIONS; one++) {
    lanes *from = sums_at(in, 1, 0) + one->number * length;
    for (int k = one->count - 1; k >= 0 && one->target; k--)
      multiply_by_circulant(in, &one->stages[k], -1.0, from, KINDS * length, k ? NULL : factor, k ? from : F,
          k ? KINDS * length : n);
  }
}

#ifdef DIAGONALS
/* Adds the diagonal of C^T D C to F, for each C of mean squares of its entries times the derivatives D. */
static void add_diagonals(const transforms *in, const problem *arrays, lanes *F, long long n)
{
  const long long length = STATES * in->count;
  convolution all[CONVOLUTIONS];
  describe_convolutions(arrays, all);
  for (const convolution *one = all; one < all + CONVOLUTIONS; one++) {
    const circulant *by = one->stages;
    const section own = share_of(in->run, by->outer * by->size * by->inner);
    double square = 1.0;
    for (int k = 0; k < one->count; k++) {
      const plan of = shared_plan(in, by + k);
      const long long size = by[k].size;
      double sum = 0.0; /* of |L_j|^2 / size^2, of even sizes divided by 4 */
      for (long long j = 0; 2 * j <= size; j++)
        sum += (j == 0 || 2 * j == size ? 1.0 : 2.0) * (of.re[j] * of.re[j] + of.im[j] * of.im[j]);
      square *= (double)size * (size % 2 ? sum : 4.0 * sum);
    }
    for (int group = 0; group < GROUPS && one->target; group++)
      for (long long i = by->start + own.first; i < by->start + own.end; i++)
        F[group * n + i] += square * sums_at(in, 1, group)[one->number * length + i];
  }
  wait_at_barrier(in->run);
}

#endif

#ifdef CIRCULANT_MODES
/* Adds the eigenvalues |L_k|^2 times the mean derivative D of C^T D C to F, for each C. */
static void add_modes(const transforms *in, const problem *arrays, lanes *F, long long n)
{
  const long long length = STATES * in->count;
  convolution all[CONVOLUTIONS];
  describe_convolutions(arrays, all);
  for (int kind = 0; kind < KINDS; kind++)
    average_places(in->run, arrays, sums_at(in, 1, 0) + kind * length, KINDS * length);
  for (const convolution *one = all; one < all + CONVOLUTIONS; one++) {
    const circulant *by = one->stages;
    const section own = share_of(in->run, by->outer * by->size * by->inner);
    plan of[MOST_STAGES];
    for (int k = 0; k < one->count; k++)
      of[k] = shared_plan(in, by + k);
    for (long long i = by->start + own.first; i < by->start + own.end && one->target; i++) {
      double square = 1.0;
      for (int k = 0; k < one->count; k++) {
        const long long mode = mode_of(by + k, i);
        const double unit = (double)(by[k].size % 2 ? by[k].size : 2 * by[k].size);
        square *= unit * unit * (of[k].re[mode] * of[k].re[mode] + of[k].im[mode] * of[k].im[mode]);
      }
      for (int group = 0; group < GROUPS; group++)
        F[group * n + i] += square * sums_at(in, 1, group)[one->number * length + i];
    }
  }
  wait_at_barrier(in->run);
}
#endif

/* Returns all convolutions of a single state in new memory, NULL without memory. */
static double *sums_of_state(const problem *arrays, const double *q)
{
  const long long count = coordinates_of(arrays), length = STATES * count;
  const run_memory alone = {0};
  double *memory = calloc((size_t)(TRANSFORM_WORK * count + ALIGNMENT), sizeof(double));
  double *state = malloc(sizeof(double) * (size_t)(length * (GROUPS * WIDTH + KINDS) + ALIGNMENT));
  const transforms in = transforms_in(&alone, memory, count);
  lanes *x = (lanes *)(((uintptr_t)state + 63) / 64 * 64);
  double *values = state;
  if (memory && state) {
    for (int group = 0; group < GROUPS; group++)
      for (long long i = 0; i < length; i++)
        x[group * length + i] = lanes_of(q[i]);
    find_sums(&in, arrays, 0, x, length);
    for (long long i = 0; i < KINDS * length; i++)
      values[i] = *(const double *)&sums_at(&in, 0, 0)[i];
  } else {
    free(state);
    values = NULL;
  }
  free(memory);
  return values;
}
