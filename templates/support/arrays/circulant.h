#include <stdint.h>
#include <stdlib.h>

#include "arrays.h"
#include "lattice_transform.h"

/* Products with circulant matrices along an axis by fast Fourier transforms: convolutions
 *
 *   (C x)_i = sum_j c[j - i] x_j,  with the eigenvalues  L_k = sum_d c[d] exp(2 pi i k d / size),
 *
 * their powers and transposes, and forces of sums over pairs with c[d] = c[size - d],
 *
 *   f sum_(i<j) c[j - i] (x_i - x_j)^2 / 2:  f C x,  (C x)_i = sum_j c[j - i] (x_i - x_j),
 *   L_k = sum_d c[d] (1 - cos(2 pi k d / size)) = 2 sum_d c[d] sin^2(pi k d / size).
 *
 * Of an axis of even size, the places 2 j and 2 j + 1 of a line are real and imaginary part of a line of half the size.
 * From the transforms E, O of even and odd places follow the modes k and k + size/2, E + w O and E - w O with w =
 * exp(-2 pi i k / size); the eigenvalue of the latter is the conjugate of L_(size/2 - k). Requires: coordinates_of;
 * PLANS, KINDS, SUM_VECTORS and STATES, the numbers of circulant matrices, of convolutions, of vectors of their values,
 * and of vectors of a state. */

enum {
  PLAN = 7, /* numbers per place of an axis */
  ALIGNMENT = 8,
  WIDTH = (int)(sizeof(lanes) / sizeof(double)),
  TRANSFORMED = 4 * GROUPS * WIDTH, /* numbers per coordinate: two complex arrays */
  TRANSFORM_WORK = PLAN * PLANS + ALIGNMENT + TRANSFORMED + SUM_VECTORS * KINDS * STATES * GROUPS * WIDTH
};

/* Places of x: `outer` lines of `size` places with `inner` numbers each, from `start`. A power of a convolution, 0 for
 * sums over pairs. */
typedef struct {
  long long start, outer, size, inner;
  const double *coefficients;
  int power, plan;
} circulant;

/* Coefficients that a plan was made for; roots of unity for both sizes; eigenvalues 0 to size/2, divided by the size,
 * of even sizes by twice the size. */
typedef struct {
  double *usable, *coefficients, *re, *im;
  roots of_half, of_size;
} plan;

/* Workspace: plans, aligned arrays, values of convolutions for `count` coordinates. */
typedef struct {
  const run_memory *run;
  long long count;
  double *plans;
  lanes *spare, *sums;
} transforms;

static transforms transforms_in(const run_memory *run, double *memory, long long count)
{
  lanes *spare = (lanes *)(((uintptr_t)(memory + PLAN * PLANS * count) + 63) / 64 * 64);
  return (transforms){run, count, memory, spare, spare + 4 * GROUPS * count};
}

static transforms transforms_of(const run_memory *run, const problem *arrays)
{
  const long long count = coordinates_of(arrays);
  return transforms_in(run, run->work + (WORK - TRANSFORM_WORK) * count, count);
}

/* The plan of a circulant matrix. */
static plan plan_at(double *memory, long long size)
{
  const long long half = size / 2;
  double *re = memory + 1 + size, *im = re + half + 1, *next = im + half + 1;
  double *first = size % 8 == 0 ? next + 2 * half + 2 * size : NULL; /* then the radix is 4 or 8 */
  const roots of_half = {next, next + half, first}, of_size = {next + 2 * half, next + 2 * half + size, NULL};
  return (plan){memory, memory + 1, re, im, of_half, of_size};
}

/* Computes the transform of real coefficients in every number of x. */
static void transform_coefficients(const plan *of, long long size, const double *coefficients, complex_lanes *x)
{
  const run_memory alone = {0};
  const axis along = {0, 1, size, 1, of->of_size};
  complex_lanes y = {x->re + 2 * GROUPS * size, x->re + 3 * GROUPS * size};
  for (long long j = 0; j < GROUPS * size; j++)
    x->re[j] = lanes_of(coefficients[j % size]), x->im[j] = lanes_of(0.0);
  transform(&alone, &along, x, &y, size);
}

/* Computes the eigenvalues of sums over pairs; returns 0 if C is not circulant or has a large prime factor. By
 * sin^2 d x / sin^2 x = d + 2 sum_(m < d) (d - m) cos 2 m x (Fejer) they are 2 sin^2(pi k / size) times the transform
 * of e[m] = sum_(d > m) (d - m) c[d], which keeps the relative accuracy of small eigenvalues. */
static int find_eigenvalues_of_pairs(const plan *of, long long size, lanes *spare)
{
  complex_lanes x = {spare, spare + GROUPS * size};
  double *sums = of->re, *whole = (double *)(spare + 2 * GROUPS * size);
  compensated sum = {0.0, 0.0}, twice = {0.0, 0.0};
  int usable = can_be_transformed(size % 2 ? size : size / 2);
  for (long long d = 1; 2 * d < size; d++)
    usable &= of->coefficients[d] == of->coefficients[size - d];
  if (!usable)
    return 0;
  for (long long d = size / 2; d >= 0; d--) {
    sums[d] = twice.sum + twice.rest;
    add_to_sum(&sum, d == 0 ? 0.0 : (2 * d < size ? 2.0 : 1.0) * of->coefficients[d]); /* c[d] = c[size - d] */
    add_to_sum(&twice, sum.sum), add_to_sum(&twice, sum.rest);
  }
  for (long long d = 0; d < size; d++)
    whole[d] = sums[2 * d <= size ? d : size - d];
  transform_coefficients(of, size, whole, &x);
  for (long long k = 0; 2 * k <= size; k++) {
    const double s = sin(3.141592653589793 * (double)k / (double)size);
    of->re[k] = 2.0 * s * s * *(const double *)&x.re[k];
    of->im[k] = 0.0;
  }
  return 1;
}

/* Computes the eigenvalues of a power of a convolution by a transform; those of symmetric coefficients are real, those
 * of antisymmetric ones imaginary. */
static void find_eigenvalues(const plan *of, const circulant *by, lanes *spare)
{
  const long long size = by->size;
  complex_lanes x = {spare, spare + GROUPS * size};
  int even = 1, odd = of->coefficients[0] == 0.0;
  for (long long d = 1; d < size; d++) {
    even &= of->coefficients[d] == of->coefficients[size - d];
    odd &= of->coefficients[d] == -of->coefficients[size - d];
  }
  transform_coefficients(of, size, of->coefficients, &x);
  for (long long k = 0; 2 * k <= size; k++) {
    const double re = odd ? 0.0 : *(const double *)&x.re[k];
    const double im = even || k == 0 || 2 * k == size ? 0.0 : -*(const double *)&x.im[k];
    of->re[k] = 1.0, of->im[k] = 0.0;
    for (int power = 0; power < by->power; power++) {
      const double last = of->re[k];
      of->re[k] = last * re - of->im[k] * im;
      of->im[k] = last * im + of->im[k] * re;
    }
  }
}

/* Sets all roots of a size: those of a quarter, if there is one, are turned. */
static void fill_all_roots(roots of_one, long long size)
{
  const long long quarter = size % 4 == 0 ? size / 4 : size;
  fill_roots(of_one, size, 0, quarter);
  for (long long k = quarter; k < size; k++) {
    of_one.cosine[k] = of_one.sine[k - quarter];
    of_one.sine[k] = -of_one.cosine[k - quarter];
  }
}

/* Sets the coefficients of the first pass of radix 4 or 8, 2 size numbers at most. */
static void fill_first(roots of_one, long long size)
{
  const long long factor = factor_of(size), together = size / factor;
  double *next = of_one.first;
  for (long long r = 1; r < factor; r++, next += 2 * together)
    for (long long place = 0; place < together; place++)
      next[place] = of_one.cosine[r * place], next[together + place] = of_one.sine[r * place];
}

/* Makes the plan of a matrix unless it has these coefficients; not usable if pairs have to be summed. */
static void make_plan(const plan *of, const circulant *by, lanes *spare)
{
  const long long size = by->size, half = size / 2;
  const double unit = 1.0 / (double)(size % 2 ? size : 2 * size);
  if (memcmp(of->coefficients, by->coefficients, sizeof(double) * (size_t)size) == 0)
    return;
  memcpy(of->coefficients, by->coefficients, sizeof(double) * (size_t)size);
  fill_all_roots(of->of_size, size);
  *of->usable = by->power > 0 || find_eigenvalues_of_pairs(of, size, spare);
  if (*of->usable == 0.0)
    return;
  for (long long k = 0; k < half; k++) /* of even sizes */
    of->of_half.cosine[k] = of->of_size.cosine[2 * k], of->of_half.sine[k] = of->of_size.sine[2 * k];
  if (of->of_half.first)
    fill_first(of->of_half, half);
  if (by->power > 0)
    find_eigenvalues(of, by, spare);
  for (long long k = 0; k <= half; k++)
    of->re[k] *= unit, of->im[k] *= unit;
}

/* Multiplies the modes k and k + size/2 by their eigenvalues, from z_k and z_(half - k) of half the size. The imaginary
 * parts of the eigenvalues are multiplied by `turn`: -1 for the transpose, 0 if they are 0. */
static inline void multiply_modes(const plan *of, long long half, long long k, double turn, lanes *re, lanes *im,
    lanes *other_re, lanes *other_im)
{
  const double c = of->of_size.cosine[k], s = of->of_size.sine[k], one = of->re[k], other = of->re[half - k];
  const lanes even = *re + *other_re, even_i = *im - *other_im, odd = *im + *other_im, odd_i = *other_re - *re;
  const lanes turned = c * odd - s * odd_i, turned_i = c * odd_i + s * odd;
  const lanes sum = even + turned, sum_i = even_i + turned_i, rest = even - turned, rest_i = even_i - turned_i;
  lanes low = one * sum, low_i = one * sum_i, high = other * rest, high_i = other * rest_i;
  if (turn != 0.0) {
    const double one_i = turn * of->im[k], other_i = -turn * of->im[half - k];
    low -= one_i * sum_i, low_i += one_i * sum;
    high -= other_i * rest_i, high_i += other_i * rest;
  }
  {
    const lanes x = low + high, x_i = low_i + high_i, gap = low - high, gap_i = low_i - high_i;
    const lanes y = c * gap + s * gap_i, y_i = c * gap_i - s * gap;
    *re = x - y_i, *im = x_i + y;
    *other_re = x + y_i, *other_im = y - x_i;
  }
}

/* Multiplies the modes k = first to end - 1, which are not half / 2 or 0, and half - k of a line. */
static inline __attribute__((always_inline)) void multiply_range(const plan *of, long long half, section here,
    double turn, long long inner, lanes *restrict re, lanes *restrict im, lanes *restrict high, lanes *restrict high_i)
{
  for (long long k = here.first; k < here.end; k++)
    for (long long b = 0; b < inner; b++) {
      const long long one = k * inner + b, other = b - k * inner;
      multiply_modes(of, half, k, turn, re + one, im + one, high + other, high_i + other);
    }
}

/* Multiplies the modes of this thread, of lines of half the size. */
static inline void multiply_half_lines(const run_memory *run, const axis *along, const plan *of, double turn,
    complex_lanes z, long long n)
{
  const long long half = along->size, modes = half / 2 + 1, inner = along->inner;
  const section own = share_of(run, along->outer * modes);
  for (int group = 0; group < GROUPS; group++)
    for (long long at = own.first, k = at % modes, end; at < own.end; at += end - k, k = 0) {
      const long long line = group * n + at / modes * half * inner;
      lanes *re = z.re + line, *im = z.im + line, *high = re + half * inner, *high_i = im + half * inner;
      section here = {k > 1 ? k : 1, 0};
      end = between(0, k + own.end - at, modes);
      here.end = between(0, end, (half + 1) / 2);
      for (long long b = 0; b < inner; b++) { /* modes that are their own partners */
        if (k == 0)
          multiply_modes(of, half, 0, turn, re + b, im + b, re + b, im + b);
        if (end == modes && half % 2 == 0)
          multiply_modes(of, half, half / 2, turn, re + half / 2 * inner + b, im + half / 2 * inner + b,
              re + half / 2 * inner + b, im + half / 2 * inner + b);
      }
      if (inner == 1)
        multiply_range(of, half, here, turn, 1, re, im, high, high_i);
      else
        multiply_range(of, half, here, turn, inner, re, im, high, high_i);
    }
}

/* Multiplies the modes of this thread, of whole lines. */
static void multiply_whole_lines(const run_memory *run, const axis *along, const plan *of, double turn, complex_lanes z,
    long long n)
{
  const long long size = along->size;
  const section own = share_of(run, along->outer * size);
  for (int group = 0; group < GROUPS; group++)
    for (long long at = own.first; at < own.end; at++) {
      const long long k = at % size, mode = 2 * k <= size ? k : size - k, first = group * n + at * along->inner;
      const double re = of->re[mode], im = turn * (mode == k ? of->im[mode] : -of->im[mode]);
      for (long long i = first; i < first + along->inner; i++) {
        const lanes x = z.re[i];
        z.re[i] = re * x - im * z.im[i];
        z.im[i] = re * z.im[i] + im * x;
      }
    }
}

/* Copies places of x to z, of axes of even size even and odd ones as real and imaginary parts, or places of z to y;
 * with a factor f adds f z to them. */
static inline __attribute__((always_inline)) void take_places(long long places, long long inner, int halves,
    const lanes *restrict x, lanes *restrict re, lanes *restrict im)
{
  for (long long place = 0; place < places; place++)
    for (long long b = 0; b < inner; b++) {
      re[place * inner + b] = x[(1 + halves) * place * inner + b];
      im[place * inner + b] = halves ? x[(1 + halves) * place * inner + inner + b] : lanes_of(0.0);
    }
}

static inline __attribute__((always_inline)) void give_places(long long places, long long inner, int halves, int adds,
    lanes factor, const lanes *restrict re, const lanes *restrict im, lanes *restrict y)
{
  for (long long place = 0; place < places; place++)
    for (long long b = 0; b < inner; b++) {
      lanes *to = y + (1 + halves) * place * inner + b;
      to[0] = adds ? to[0] + factor * re[place * inner + b] : re[place * inner + b];
      if (halves)
        to[inner] = adds ? to[inner] + factor * im[place * inner + b] : im[place * inner + b];
    }
}

static void take_lines(const run_memory *run, const axis *along, int halves, complex_lanes z, long long n,
    const lanes *x, long long apart)
{
  const long long inner = along->inner;
  const section own = share_of(run, along->outer * along->size);
  for (int group = 0; group < GROUPS; group++) {
    const long long at = group * n + own.first * inner, places = own.end - own.first;
    const lanes *from = x + group * apart + (1 + halves) * own.first * inner;
    if (inner == 1 && halves)
      take_places(places, 1, 1, from, z.re + at, z.im + at);
    else
      take_places(places, inner, halves, from, z.re + at, z.im + at);
  }
  wait_at_barrier(run);
}

static void give_lines(const run_memory *run, const axis *along, int halves, complex_lanes z, long long n,
    const lanes *factor, lanes *y, long long apart)
{
  const long long inner = along->inner;
  const section own = share_of(run, along->outer * along->size);
  for (int group = 0; group < GROUPS; group++) {
    const long long at = group * n + own.first * inner, places = own.end - own.first;
    lanes *to = y + group * apart + (1 + halves) * own.first * inner;
    if (inner == 1 && halves && factor)
      give_places(places, 1, 1, 1, factor[group], z.re + at, z.im + at, to);
    else if (inner == 1 && halves)
      give_places(places, 1, 1, 0, lanes_of(0.0), z.re + at, z.im + at, to);
    else
      give_places(places, inner, halves, factor != NULL, factor ? factor[group] : lanes_of(0.0), z.re + at, z.im + at,
          to);
  }
  wait_at_barrier(run);
}

/* The plan of a matrix, made by one thread while the others wait. */
static plan shared_plan(const transforms *in, const circulant *by)
{
  const plan of = plan_at(in->plans + by->plan * PLAN * in->count, by->size);
  if (!in->run->thread_barrier || in->run->part == 0)
    make_plan(&of, by, in->spare);
  wait_at_barrier(in->run);
  return of;
}

/* y = C x, for `turn` -1 the transpose, or with factors f adds f C x; groups of x and y are `apart` and `behind`
 * numbers apart. */
static void multiply_by_plan(const transforms *in, const circulant *by, const plan *of, double turn, const lanes *X,
    long long apart, const lanes *factor, lanes *Y, long long behind)
{
  const run_memory *run = in->run;
  const int halves = by->size % 2 == 0;
  const long long size = halves ? by->size / 2 : by->size, n = by->outer * size * by->inner;
  const axis along = {0, by->outer, size, by->inner, halves ? of->of_half : of->of_size};
  complex_lanes x = {in->spare, in->spare + GROUPS * n}, z;
  complex_lanes y = {in->spare + 2 * GROUPS * n, in->spare + 3 * GROUPS * n};
  take_lines(run, &along, halves, x, n, X + by->start, apart);
  transform(run, &along, &x, &y, n);
  if (!halves)
    multiply_whole_lines(run, &along, of, turn, x, n);
  else if (by->power == 0)
    multiply_half_lines(run, &along, of, 0.0, x, n); /* real eigenvalues */
  else
    multiply_half_lines(run, &along, of, turn, x, n);
  wait_at_barrier(run);
  z.re = x.im, z.im = x.re; /* the inverse transform exchanges the parts */
  x = y, y.re = x.im, y.im = x.re;
  transform(run, &along, &z, &y, n);
  x.re = z.im, x.im = z.re;
  give_lines(run, &along, halves, x, n, factor, Y + by->start, behind);
}

#ifdef CIRCULANT_MODES
/* Replaces the values of all places of a lattice by their mean, of each component; groups of F are n numbers apart. */
static void average_places(const run_memory *run, const problem *arrays, lanes *F, long long n)
{
  const long long half = coordinates_of(arrays);
  lattice all[LATTICES];
  describe_lattices(arrays, all);
  for (const lattice *one = all; one < all + LATTICES && (!run->thread_barrier || run->part == 0); one++)
    for (long long k = 0; k < GROUPS * STATES * one->components; k++) {
      const long long places = positions_of(one), count = one->components;
      lanes *at = F + k / count / STATES * n + k / count % STATES * half + one->first + k % count, sum = lanes_of(0.0);
      for (long long i = 0; i < places; i++)
        sum += at[i * count];
      for (long long i = 0; i < places; i++)
        at[i * count] = sum * (1.0 / (double)places);
    }
  wait_at_barrier(run);
}

/* Index in the plan of the eigenvalue that belongs to a place of an array in Fourier space. */
static inline long long mode_of(const circulant *by, long long place)
{
  const long long k = (place - by->start) / by->inner % by->size;
  return 2 * k <= by->size ? k : by->size - k;
}
#endif

#ifdef PAIRS
#ifdef CIRCULANT_MODES
/* Adds the eigenvalues f L_k of a sum over pairs to F; returns 0 if C is not circulant. */
static int add_modes_of_pairs(const transforms *in, const circulant *by, const lanes *factor, lanes *F, long long n)
{
  const plan of = shared_plan(in, by);
  const section own = share_of(in->run, by->outer * by->size * by->inner);
  const double unit = (double)(by->size % 2 ? by->size : 2 * by->size);
  if (*of.usable == 0.0)
    return 0;
  for (int group = 0; group < GROUPS; group++)
    for (long long i = by->start + own.first; i < by->start + own.end; i++)
      F[group * n + i] += unit * of.re[mode_of(by, i)] * factor[group];
  wait_at_barrier(in->run);
  return 1;
}
#endif

/* Adds the forces f C x of a sum over pairs, or its diagonal, if X is NULL, to F, whose groups are n numbers apart; x:
 * groups `apart`. Returns 0 if the pairs have to be summed. */
static int add_pairs(const transforms *in, const circulant *by, const lanes *X, long long apart, const lanes *factor,
    lanes *F, long long n)
{
  const plan of = shared_plan(in, by);
  const section own = share_of(in->run, by->outer * by->size * by->inner);
  double sum = 0.0;
  if (*of.usable == 0.0)
    return 0;
  if (X) {
    multiply_by_plan(in, by, &of, 0.0, X, apart, factor, F, n);
    return 1;
  }
  for (long long d = 1; d < by->size; d++)
    sum += by->coefficients[d];
  for (int group = 0; group < GROUPS; group++)
    for (long long i = own.first; i < own.end; i++)
      F[group * n + by->start + i] += sum * factor[group];
  wait_at_barrier(in->run);
  return 1;
}

/* Adds f x C x of a line, whose transform is in every width-th number of re and im, from the squares of its modes. */
static void add_squares(const plan *of, long long size, long long width, const double *re, const double *im,
    double factor, compensated *total)
{
  const long long half = size / 2;
  for (long long k = 0; size % 2 && k <= half; k++) {
    const double square = re[k * width] * re[k * width] + im[k * width] * im[k * width];
    add_to_sum(total, (k == 0 ? factor : 2.0 * factor) * of->re[k] * square);
  }
  for (long long k = 0; size % 2 == 0 && 2 * k <= half; k++) {
    const long long one = k * width, other = (half - k) % half * width;
    const double c = of->of_size.cosine[k], s = of->of_size.sine[k];
    const double even = re[one] + re[other], even_i = im[one] - im[other];
    const double odd = im[one] + im[other], odd_i = re[other] - re[one];
    const double turned = c * odd - s * odd_i, turned_i = c * odd_i + s * odd;
    const double low = (even + turned) * (even + turned) + (even_i + turned_i) * (even_i + turned_i);
    const double high = (even - turned) * (even - turned) + (even_i - turned_i) * (even_i - turned_i);
    const double twice = k == 0 || 2 * k == half ? 0.5 * factor : factor; /* the modes k and size - k */
    add_to_sum(total, twice * of->re[k] * low);
    add_to_sum(total, twice * of->re[half - k] * high);
  }
}

/* Adds f x C x to a sum, by transforms of several lines at a time; returns 0 if the pairs have to be summed. */
static int add_energy(const circulant *by, const double *x, double factor, compensated *total)
{
  const int halves = by->size % 2 == 0;
  const long long size = by->size, places = halves ? size / 2 : size;
  double *memory = calloc((size_t)((PLAN * PLANS + TRANSFORMED) * size + ALIGNMENT), sizeof(double));
  const run_memory alone = {0};
  const transforms in = transforms_in(&alone, memory, size);
  complex_lanes z = {in.spare, in.spare + GROUPS * places};
  complex_lanes y = {z.re + 2 * GROUPS * places, z.im + 2 * GROUPS * places};
  const plan of = plan_at(memory, size);
  const axis along = {0, 1, places, 1, halves ? of.of_half : of.of_size};
  if (memory)
    make_plan(&of, by, in.spare);
  if (!memory || *of.usable == 0.0) {
    free(memory);
    return 0;
  }
  for (long long first = 0; first < by->outer * by->inner; first += GROUPS * WIDTH) {
    const long long count = between(0, by->outer * by->inner - first, GROUPS * WIDTH);
    for (long long k = 0; k < count; k++) {
      const long long row = (first + k) / by->inner * size, column = by->start + (first + k) % by->inner;
      const long long at = k / WIDTH * places * WIDTH + k % WIDTH;
      for (long long j = 0; j < places; j++) {
        const long long here = (row + (1 + halves) * j) * by->inner + column;
        ((double *)z.re)[at + j * WIDTH] = x[here];
        ((double *)z.im)[at + j * WIDTH] = halves ? x[here + by->inner] : 0.0;
      }
    }
    transform(&alone, &along, &z, &y, places);
    for (long long k = 0; k < count; k++) {
      const long long at = k / WIDTH * places * WIDTH + k % WIDTH;
      add_squares(&of, size, WIDTH, (const double *)z.re + at, (const double *)z.im + at, factor, total);
    }
  }
  free(memory);
  return 1;
}

#endif
