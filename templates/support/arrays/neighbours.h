#include <stdlib.h>

#include "arrays.h"

/* Lists of neighbours (L. Verlet, Phys. Rev. 159 (1967) 98) by cells of at least the cutoff plus the skin (Hockney and
 * Eastwood, Computer Simulation Using Particles, 1981). A list contains all pairs closer than cutoff + skin at the
 * positions at which it was made; it contains all pairs closer than the cutoff while no point has moved from there by
 * half of the skin. This is checked for the positions of every evaluation of forces. Neighbours are in ascending order,
 * and pairs beyond the cutoff add zeros, so that no bit of a result depends on when a list was made. */
typedef NAME(neighbours) neighbours;

enum {
  AXES_OF_CELLS = 3,
  CUTOFF = AXES_OF_CELLS,
  SKIN,
  LENGTHS /* periods (0: none), cutoff, skin */
};

/* Points of a list: coordinates start to start + count components - 1. */
typedef struct {
  long long start, count;
  int components;
  double lengths[LENGTHS];
} point_list;

/* Cells in row-major order; points sorted by cell: point order[k] has the components x[axis][k]. */
typedef struct {
  long long size[AXES_OF_CELLS], *first;
  double width[AXES_OF_CELLS], inverse[AXES_OF_CELLS], *x[AXES_OF_CELLS]; /* inverse: 1 / period, or 0 */
  int *order;
} cells;

/* Returns the largest distance of points from the positions `at`; X has `width` positions per coordinate and group. */
static double farthest(const point_list *of, const double *at, const double *X, long long groups, long long apart,
    long long width)
{
  double largest = 0.0;
  for (long long g = 0; g < groups; g++)
    for (long long i = 0; i < of->count; i++)
      for (long long lane = 0; lane < width; lane++) {
        double square = 0.0;
        for (long long k = i * of->components; k < (i + 1) * of->components; k++) {
          const double d = X[(g * apart + of->start + k) * width + lane] - at[k];
          square += d * d;
        }
        largest = square > largest ? square : largest;
      }
  return sqrt(largest);
}

/* Cells of width `reach` or more, about one per point at most; without a period cells are repeated. */
static long long divide_box(const point_list *of, double reach, cells *in)
{
  const double most = 1.0 + pow((double)of->count, 1.0 / of->components);
  long long total = 1;
  for (int k = 0; k < AXES_OF_CELLS; k++) {
    const double period = of->lengths[k], fit = k >= of->components ? 1.0 : period > 0.0 ? period / reach
                                                                                         : most;
    in->size[k] = (long long)(fit < most ? fit : most);
    if (in->size[k] < 3)
      in->size[k] = 1;
    in->inverse[k] = period > 0.0 ? 1.0 / period : 0.0;
    in->width[k] = period > 0.0 ? period / (double)in->size[k] : reach;
    total *= in->size[k];
  }
  return total;
}

static long long cell_of(const cells *in, const point_list *of, const double *x)
{
  long long cell = 0;
  for (int k = 0; k < AXES_OF_CELLS; k++) {
    long long place = 0;
    if (in->size[k] > 1) {
      const double turns = x[k < of->components ? k : 0] / in->width[k] / (double)in->size[k];
      place = between(0, (long long)((turns - floor(turns)) * (double)in->size[k]), in->size[k] - 1);
    }
    cell = cell * in->size[k] + place;
  }
  return cell;
}

/* Sorts points by cell. */
static void sort_points(cells *in, const point_list *of, const double *x, long long total)
{
  for (long long i = 0; i < of->count; i++)
    in->first[cell_of(in, of, x + i * of->components) + 1]++;
  for (long long c = 0; c < total; c++)
    in->first[c + 1] += in->first[c];
  for (long long i = of->count - 1; i >= 0; i--) { /* descending: first[c + 1] becomes the start of cell c */
    const long long k = --in->first[cell_of(in, of, x + i * of->components) + 1];
    in->order[k] = (int)i;
    for (int axis = 0; axis < of->components; axis++)
      in->x[axis][k] = x[i * of->components + axis];
  }
}

/* Appends the points of a cell before point i that are closer to it than `reach`; returns their new number. */
static long long append(const cells *in, const point_list *of, long long cell, int i, const double *x, double reach,
    long long total, int *found, long long count)
{
  enum { PART = 64 };
  long long end = cell + 2 <= total ? in->first[cell + 2] : of->count;
  while (end > in->first[cell + 1] && in->order[end - 1] >= i) /* in ascending order */
    end--;
  for (long long begin = in->first[cell + 1]; begin < end; begin += PART) {
    const long long size = end - begin < PART ? end - begin : PART;
    double square[PART];
    for (int axis = 0; axis < of->components; axis++) {
      const double *other = in->x[axis] + begin, period = of->lengths[axis], by = in->inverse[axis];
      for (long long k = 0; k < size; k++) {
        const double d = x[axis] - other[k], shortest = d - period * rint(d * by);
        square[k] = (axis > 0 ? square[k] : 0.0) + shortest * shortest;
      }
    }
    for (long long k = 0; k < size; k++) {
      found[count] = in->order[begin + k];
      count += square[k] < reach * reach;
    }
  }
  return count;
}

/* Enlarges an array of indices to at least `size`; returns 0 if there is not enough memory. */
static int reserve(int **indices, long long *capacity, long long size)
{
  if (*indices && size <= *capacity)
    return 1;
  int *larger = realloc(*indices, sizeof(int) * (size_t)(size + size / 2));
  if (!larger)
    return 0;
  *indices = larger, *capacity = size + size / 2;
  return 1;
}

/* Appends the neighbours j < i of point i from its cell and the adjacent ones; returns 0 without memory. */
static int find_lower(neighbours *list, const point_list *of, const cells *in, int i, const double *x, double reach,
    long long total, long long *count)
{
  const long long cell = cell_of(in, of, x), *size = in->size;
  const long long at[AXES_OF_CELLS] = {cell / size[2] / size[1], cell / size[2] % size[1], cell % size[2]};
  if (!reserve(&list->lower, &list->capacity_lower, *count + of->count))
    return 0;
  for (long long a = size[0] > 1 ? -1 : 0; a <= (size[0] > 1); a++)
    for (long long b = size[1] > 1 ? -1 : 0; b <= (size[1] > 1); b++)
      for (long long c = size[2] > 1 ? -1 : 0; c <= (size[2] > 1); c++) {
        const long long row = wrapped_index(at[0] + a, size[0]) * size[1] + wrapped_index(at[1] + b, size[1]);
        *count = append(in, of, row * size[2] + wrapped_index(at[2] + c, size[2]), i, x, reach, total, list->lower,
            *count);
      }
  return 1;
}

/* Makes the rows (i; its neighbours j > i) from rows (j; its neighbours i < j), which leaves j in ascending order. */
static int transpose(neighbours *list, const point_list *of, const long long *begin)
{
  const long long count = of->count, pairs = begin[count];
  if (!reserve(&list->others, &list->capacity, pairs + 1))
    return 0;
  memset(list->first, 0, sizeof(long long) * (size_t)(count + 2));
  for (long long k = 0; k < pairs; k++)
    list->first[list->lower[k] + 2]++;
  for (long long i = 0; i < count; i++)
    list->first[i + 2] += list->first[i + 1];
  for (long long j = 0; j < count; j++)
    for (long long k = begin[j]; k < begin[j + 1]; k++)
      list->others[list->first[list->lower[k] + 1]++] = (int)j;
  return 1;
}

/* Makes the list of all pairs closer than `reach`; returns 0 without memory. */
static int make_list(neighbours *list, const point_list *of, const double *x, double reach)
{
  const long long count = of->count;
  cells in = {0};
  const long long total = divide_box(of, reach, &in);
  double *memory = malloc(sizeof(double) * (size_t)(of->components * count + 1));
  long long *starts = calloc((size_t)(total + count + 3), sizeof(long long)), *begin = starts + total + 2, pairs = 0;
  int done = memory && starts && (in.order = malloc(sizeof(int) * (size_t)(count + 1)));
  if (done) {
    in.first = starts;
    for (int axis = 0; axis < of->components; axis++)
      in.x[axis] = memory + axis * count;
    sort_points(&in, of, x, total);
    for (long long j = 0; j < count && done; j++) {
      done = find_lower(list, of, &in, (int)j, x + j * of->components, reach, total, &pairs);
      begin[j + 1] = pairs;
    }
    done = done && transpose(list, of, begin);
  }
  free(in.order), free(starts), free(memory);
  return done;
}

/* Makes a list again if it may lack a pair closer than the cutoff at the positions X; the new one is of the positions
 * q, with a larger skin if X are far from there. A list that cannot be made is empty, and marked as failed. */
static void update_list(neighbours *list, const point_list *of, const double *q, const double *X, long long groups,
    long long apart, long long width)
{
  const double cutoff = of->lengths[CUTOFF], skin = of->lengths[SKIN], half = 0.499; /* < 1/2 for rounding */
  const size_t size = sizeof(double) * (size_t)(of->count * of->components);
  double moved;
  if (list->at && list->count == of->count && memcmp(list->lengths, of->lengths, sizeof of->lengths) == 0 &&
      farthest(of, list->at, X, groups, apart, width) <= list->valid)
    return;
  if (!list->at || list->count != of->count) {
    free(list->at), free(list->first);
    list->at = malloc(size + 1), list->first = malloc(sizeof(long long) * (size_t)(of->count + 2));
    list->count = of->count;
  }
  list->failed = 1, list->valid = -1.0;
  if (!list->at || !list->first)
    return;
  memset(list->first, 0, sizeof(long long) * (size_t)(of->count + 2));
  memcpy(list->lengths, of->lengths, sizeof of->lengths);
  memcpy(list->at, q + of->start, size);
  moved = farthest(of, list->at, X, groups, apart, width);
  if (!(cutoff > 0.0 && skin > 0.0 && moved < cutoff)) /* such a step is far too long */
    return;
  for (int k = 0; k < of->components; k++)
    if (of->lengths[k] != 0.0 && !(of->lengths[k] >= 2.0 * cutoff)) /* only the nearest image counts */
      return;
  list->valid = half * skin > moved ? half * skin : moved;
  list->made++;
  list->failed = !make_list(list, of, list->at, cutoff + list->valid / half);
  if (list->failed)
    list->valid = -1.0;
}

/* Part of the row of point i whose terms add to elements of a task; all of it if those of point i are among them. Point
 * i has `width` elements from start + i width on. */
static inline section row_of(const neighbours *list, long long i, const window *here, long long start, long long width)
{
  section row = {list->first[i], list->first[i + 1]};
  if (!here || here->whole || (start + (i + 1) * width > here->of.first && start + i * width < here->of.end))
    return row;
  while (row.first < row.end && start + (list->others[row.first] + 1) * width <= here->of.first)
    row.first++;
  while (row.first < row.end && start + list->others[row.end - 1] * width >= here->of.end)
    row.end--;
  return row;
}

static void release(neighbours *list)
{
  free(list->at), free(list->first), free(list->others), free(list->lower);
  memset(list, 0, sizeof *list);
}
