#ifndef SUPPORT_LATTICE_TRANSFORM_H
#define SUPPORT_LATTICE_TRANSFORM_H

#include "arrays.h"

/* Fast Fourier transforms along the axes of lattices, at all points of a step, with one pass per factor of the size,
 * each from one array into another (Stockham autosort; C. Van Loan, Computational Frameworks for the Fast Fourier
 * Transform, 1992, section 1.7). Requires: arrays.h, lanes, lanes_of,
 * GROUPS. */

enum { LARGEST_FACTOR = 499 }; /* of a size with an alternative: a pass costs as many products per element */

/* Real and imaginary parts of all coordinates. */
typedef struct {
  lanes *re, *im;
} complex_lanes;

/* exp(-2 pi i k / size), k = 0 .. size - 1, real and imaginary parts. */
typedef struct {
  double *cosine, *sine;
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

static int factor_of(long long size)
{
  int factor = size % 4 == 0 ? 4 : 2;
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

/* Radix-4 butterfly from x to y with the twiddle factors k, 2 k, 3 k. */
static inline void four_to_four(complex_lanes x, complex_lanes y, long long apart, long long next, const roots *of_one,
    long long k)
{
  const lanes even = x.re[0] + x.re[2 * apart], even_i = x.im[0] + x.im[2 * apart];
  const lanes odd = x.re[apart] + x.re[3 * apart], odd_i = x.im[apart] + x.im[3 * apart];
  const lanes gap = x.re[0] - x.re[2 * apart], gap_i = x.im[0] - x.im[2 * apart];
  const lanes turn = x.im[apart] - x.im[3 * apart], turn_i = x.re[3 * apart] - x.re[apart];
  const lanes re[3] = {gap + turn, even - odd, gap - turn}, im[3] = {gap_i + turn_i, even_i - odd_i, gap_i - turn_i};
  y.re[0] = even + odd, y.im[0] = even_i + odd_i;
  for (int r = 1; r < 4; r++) {
    const double c = of_one->cosine[r * k], s = of_one->sine[r * k];
    y.re[r * next] = c * re[r - 1] - s * im[r - 1];
    y.im[r * next] = c * im[r - 1] + s * re[r - 1];
  }
}

/* Butterfly of any radix. */
static inline void some_to_some(complex_lanes x, complex_lanes y, long long apart, long long next, const pass *now,
    long long k)
{
  const axis *along = now->along;
  for (long long r = 0; r < now->factor; r++) {
    lanes re = lanes_of(0.0), im = lanes_of(0.0);
    long long root = r * k;
    for (long long q = 0; q < now->factor; q++) {
      const double c = along->of_one.cosine[root], s = along->of_one.sine[root];
      re += c * x.re[q * apart] - s * x.im[q * apart];
      im += c * x.im[q * apart] + s * x.re[q * apart];
      root += r * (along->size / now->factor);
      root -= root < along->size ? 0 : along->size;
    }
    y.re[r * next] = re, y.im[r * next] = im;
  }
}

/* Transforms the numbers of a section of a place, for one group. */
static void transform_places(const pass *now, complex_lanes x, complex_lanes y, long long place, section here)
{
  const long long together = now->left / now->factor, apart = together * now->done;
  const long long k = place * (now->along->size / now->left);
  for (long long b = here.first; b < here.end; b++) {
    const long long at = place * now->done + b, to = place * now->factor * now->done + b;
    const complex_lanes from = {x.re + at, x.im + at}, into = {y.re + to, y.im + to};
    if (now->factor == 4)
      four_to_four(from, into, apart, now->done, &now->along->of_one, k);
    else
      some_to_some(from, into, apart, now->done, now, k);
  }
}

/* Performs this thread's part of a pass from x to y. */
static void make_pass(const run_memory *run, const pass *now, complex_lanes x, complex_lanes y, long long n)
{
  const axis *along = now->along;
  const long long places = now->left / now->factor, line = along->size * along->inner;
  const section own = share_of(run, along->outer * places * now->done);
  for (int g = 0; g < GROUPS; g++) {
    long long place = own.first / now->done % places, shift = g * n + along->first;
    section here = {own.first % now->done, 0};
    shift += own.first / now->done / places * line;
    for (long long k = own.first; k < own.end; k += here.end - here.first, here.first = 0) {
      const complex_lanes from = {x.re + shift, x.im + shift}, into = {y.re + shift, y.im + shift};
      here.end = between(0, here.first + own.end - k, now->done);
      transform_places(now, from, into, place, here);
      if (++place == places)
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

#endif
