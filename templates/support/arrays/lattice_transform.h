#include "arrays.h"

/* Fast Fourier transforms along the axes of lattices, at all points of a step, with one pass per factor of the size,
 * each from one array into another (Stockham autosort; C. Van Loan, Computational Frameworks for the Fast Fourier
 * Transform, 1992, section 1.7). Requires: lanes, lanes_of, GROUPS. */

enum { LARGEST_FACTOR = 499 }; /* of a size with an alternative: a pass costs as many products per element */

/* Real and imaginary parts of all coordinates. */
typedef struct {
  lanes *re, *im;
} complex_lanes;

/* exp(-2 pi i k / size), k = 0 .. size - 1, real and imaginary parts; coefficients of the first pass in the order of
 * its places, or NULL. */
typedef struct {
  double *cosine, *sine, *first;
} roots;

/* An axis of a lattice: `outer` lines of `size` places with `inner` numbers each. */
typedef struct {
  long long first, outer, size, inner;
  roots of_one;
} axis;

/* Sets entries `first` to `end` of the roots. */
static void fill_roots(roots of_one, long long size, long long first, long long end)
{
  for (long long k = first; k < end; k++) {
    const double angle = 6.283185307179586 * (double)k / (double)size;
    of_one.cosine[k] = cos(angle);
    of_one.sine[k] = -sin(angle);
  }
}

/* A pass: `left` places of a line are not yet transformed, each of `done` numbers; `factor` of them are combined. */
typedef struct {
  const axis *along;
  long long left, done;
  int factor;
} pass;

/* The factor of the next pass: 8 or 4, but not 8 before a factor 2. */
static int factor_of(long long size)
{
  int factor = size % 8 == 0 && size % 32 != 16 ? 8 : size % 4 == 0 ? 4
                                                                    : 2;
  while (size % factor)
    factor++;
  return factor;
}

static int can_be_transformed(long long size)
{
  while (size > 1 && factor_of(size) <= LARGEST_FACTOR)
    size /= factor_of(size);
  return size == 1;
}

/* Coefficients of `factor` - 1 values, real parts and imaginary parts `width` numbers behind, those of the next value
 * `width` numbers behind that and those of the next place `step` numbers behind. */
typedef struct {
  const double *values;
  long long width, step;
} coefficients;

/* Transform of four numbers. */
static inline void transform_four(lanes *re, lanes *im)
{
  const lanes even = re[0] + re[2], even_i = im[0] + im[2], odd = re[1] + re[3], odd_i = im[1] + im[3];
  const lanes gap = re[0] - re[2], gap_i = im[0] - im[2], turn = im[1] - im[3], turn_i = re[3] - re[1];
  re[0] = even + odd, im[0] = even_i + odd_i;
  re[1] = gap + turn, im[1] = gap_i + turn_i;
  re[2] = even - odd, im[2] = even_i - odd_i;
  re[3] = gap - turn, im[3] = gap_i - turn_i;
}

/* Butterflies of radix 4 or 8 of `count` values: from numbers that are `apart` to numbers that are `next` apart, those
 * of the next value `behind`. */
static inline __attribute__((always_inline)) void butterflies(int factor, const lanes *restrict re,
    const lanes *restrict im, long long apart, lanes *restrict to_re, lanes *restrict to_im, long long next,
    long long behind, coefficients by, long long count)
{
  const double half = 0.7071067811865476; /* exp(-pi i / 4) = half - i half */
  const int odd = factor == 8;
#ifndef __clang__
#pragma GCC ivdep /* places differ, which the compiler cannot know */
#endif
  for (long long b = 0; b < count; b++) {
    lanes x[8], y[8];
    for (int k = 0; k < factor; k++)
      x[k] = re[k * apart + b], y[k] = im[k * apart + b];
    for (int k = 0; odd && k < 4; k++) {
      const lanes other = x[k + 4], other_i = y[k + 4];
      x[k + 4] = x[k] - other, y[k + 4] = y[k] - other_i;
      x[k] += other, y[k] += other_i;
    }
    if (odd) {
      const lanes one = x[5], two = x[6], three = x[7];
      x[5] = half * (one + y[5]), y[5] = half * (y[5] - one);
      x[6] = y[6], y[6] = -two;
      x[7] = half * (y[7] - three), y[7] = -half * (y[7] + three);
      transform_four(x + 4, y + 4);
    }
    transform_four(x, y);
    to_re[b * behind] = x[0], to_im[b * behind] = y[0];
    for (int r = 1; r < factor; r++) {
      const int k = odd ? r / 2 + r % 2 * 4 : r;
      const double *at = by.values + 2 * (r - 1) * by.width + b * by.step;
      const double c = at[0], s = at[by.width];
      to_re[r * next + b * behind] = c * x[k] - s * y[k];
      to_im[r * next + b * behind] = c * y[k] + s * x[k];
    }
  }
}

/* Butterflies of any radix, with the coefficients of place k. */
static void butterflies_of_any_radix(const pass *now, complex_lanes x, long long apart, complex_lanes y, long long next,
    long long k, long long count)
{
  const axis *along = now->along;
  for (long long r = 0; r < now->factor; r++) {
    lanes *restrict re = y.re + r * next, *restrict im = y.im + r * next;
    long long root = r * k;
    memset(re, 0, sizeof(lanes) * (size_t)count);
    memset(im, 0, sizeof(lanes) * (size_t)count);
    for (long long q = 0; q < now->factor; q++) {
      const double c = along->of_one.cosine[root], s = along->of_one.sine[root];
      const lanes *from = x.re + q * apart, *from_i = x.im + q * apart;
      for (long long b = 0; b < count; b++) {
        re[b] += c * from[b] - s * from_i[b];
        im[b] += c * from_i[b] + s * from[b];
      }
      root += r * (along->size / now->factor);
      root -= root < along->size ? 0 : along->size;
    }
  }
}

/* Transforms a section of the numbers of a place, for one group. */
static void transform_place(const pass *now, complex_lanes x, complex_lanes y, long long place, section here)
{
  const long long together = now->left / now->factor, apart = together * now->done, next = now->done;
  const long long k = place * (now->along->size / now->left), at = place * next + here.first;
  const long long to = place * now->factor * next + here.first, count = here.end - here.first;
  const complex_lanes from = {x.re + at, x.im + at}, into = {y.re + to, y.im + to};
  double values[14];
  const coefficients by = {values, 1, 0};
  if (now->factor != 4 && now->factor != 8) {
    butterflies_of_any_radix(now, from, apart, into, next, k, count);
    return;
  }
  for (int r = 1; r < now->factor; r++)
    values[2 * r - 2] = now->along->of_one.cosine[r * k], values[2 * r - 1] = now->along->of_one.sine[r * k];
  if (now->factor == 8)
    butterflies(8, from.re, from.im, apart, into.re, into.im, next, 1, by, count);
  else
    butterflies(4, from.re, from.im, apart, into.re, into.im, next, 1, by, count);
}

/* Transforms a section of the places of a line in its first pass, for one group. */
static void transform_places(const pass *now, complex_lanes x, complex_lanes y, section here)
{
  const long long apart = now->left / now->factor, count = here.end - here.first, to = here.first * now->factor;
  const coefficients by = {now->along->of_one.first + here.first, apart, 1};
  if (now->factor == 8)
    butterflies(8, x.re + here.first, x.im + here.first, apart, y.re + to, y.im + to, 1, 8, by, count);
  else
    butterflies(4, x.re + here.first, x.im + here.first, apart, y.re + to, y.im + to, 1, 4, by, count);
}

/* Performs this thread's part of a pass from x to y. */
static void make_pass(const run_memory *run, const pass *now, complex_lanes x, complex_lanes y, long long n)
{
  const axis *along = now->along;
  const int first = now->done == 1 && along->of_one.first;
  const long long places = now->left / now->factor, line = along->size * along->inner;
  const section own = share_of(run, along->outer * places * now->done);
  for (int g = 0; g < GROUPS; g++) {
    const long long within = first ? places : now->done; /* numbers that are transformed together */
    long long place = own.first / within % (first ? 1 : places), shift = g * n + along->first;
    section here = {own.first % within, 0};
    shift += own.first / now->done / places * line;
    for (long long k = own.first; k < own.end; k += here.end - here.first, here.first = 0) {
      const complex_lanes from = {x.re + shift, x.im + shift}, into = {y.re + shift, y.im + shift};
      here.end = between(0, here.first + own.end - k, within);
      if (first)
        transform_places(now, from, into, here);
      else
        transform_place(now, from, into, place, here);
      if (first || ++place == places)
        place = 0, shift += line;
    }
  }
  wait_at_barrier(run);
}

static inline void swap(complex_lanes *x, complex_lanes *y)
{
  const complex_lanes kept = *x;
  *x = *y;
  *y = kept;
}

/* Transforms x along an axis; the result is in x, which may be exchanged with y. */
static void transform(const run_memory *run, const axis *along, complex_lanes *x, complex_lanes *y, long long n)
{
  pass now = {along, along->size, along->inner, 1};
  while (now.left > 1) {
    now.factor = factor_of(now.left);
    make_pass(run, &now, *x, *y, n);
    swap(x, y);
    now.left /= now.factor;
    now.done *= now.factor;
  }
}

#ifdef ON_LATTICES
/* An array whose first axes are those of a lattice, with `components` numbers per place. */
typedef struct {
  long long first, components, size[AXES];
  int axes;
  roots of_one[AXES];
} lattice;

static long long positions_of(const lattice *one)
{
  long long places = 1;
  for (int a = 0; a < one->axes; a++)
    places *= one->size[a];
  return places;
}
#endif
