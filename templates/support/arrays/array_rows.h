#include "arrays.h"

/* Kicks in one pass over the rows of lattices, the elements with the same first index. Forces couple rows at most REACH
 * apart, so that a row is continued as soon as those of the next rows are added. Blocks of rows are the tasks of the
 * forces: even ones before their odd neighbours, as in add_forces, so that sums round alike. FUSED: add_rows continues
 * coordinates where it adds their last forces, in the same loop over a chunk; FRESH: the forces are 0 before. Requires:
 * continue_section, CHUNK, REACH, CHUNKED_ROWS (rows are the innermost loop), rows_of, share_rows,
 * describe_coordinate_arrays; add_rows, which adds the forces that couple rows, prepare_rows and complete_rows, which
 * add others before and behind. */
enum {
  MOST_ADDENDS = 4, /* values that complete_sums adds to a coordinate */
  BORDER = (REACH + ALIGNED_NUMBERS - 1) / ALIGNED_NUMBERS * ALIGNED_NUMBERS /* at least REACH */
};

typedef struct {
  const run_memory *run;
  const problem *arrays;
  const work_arrays *work;
  const double *X; /* positions */
  double t, by, *F;
  const continuation *then;
  sharing how;
  long long rows;
  coordinate_array array[COORDINATE_ARRAYS];
  section own; /* rows that no other block changes, but for those that are continued */
} sweep;

static sharing share_rows(const run_memory *run, const problem *arrays, long long n);
static void prepare_rows(const sweep *of, section rows);
static void add_rows(sweep *of, section rows);
static void complete_rows(const sweep *of, section rows);

/* Forces that couple no rows, before or behind the others; then also the continuation. Rows may be beyond both ends. */
static void treat_rows(const sweep *of, section rows, int behind)
{
  if (rows.first < 0) {
    const section last = {rows.first + of->rows, of->rows};
    treat_rows(of, last, behind);
    rows.first = 0;
  }
  if (rows.end > of->rows) {
    const section first = {0, rows.end - of->rows};
    treat_rows(of, first, behind);
    rows.end = of->rows;
  }
  if (rows.first >= rows.end)
    return;
  (behind ? complete_rows : prepare_rows)(of, rows);
  for (int k = 0; behind && k < COORDINATE_ARRAYS; k++) {
    const coordinate_array *array = &of->array[k];
    const long long inner = (array->end - array->first) / of->rows;
    const section here = {array->first + rows.first * inner, array->first + rows.end * inner};
    continue_section(of->run, of->work, here, *of->then);
  }
}

static section block_of(const sweep *of, long long block)
{
  section rows = part_of(of->how.of, block, of->how.blocks);
  rows.first = block == 0 ? 0 : rows.first;
  rows.end = block == of->how.blocks - 1 ? of->rows : rows.end;
  return rows;
}

/* Adds `by` times the last values to consecutive coordinates, and continues those of this block that are behind. */
static inline __attribute__((always_inline)) void complete_sums(sweep *of, double by, double *F, section here,
    const addend *added, int addends)
{
  double *const row = F + here.first;
  section inside = {here.end, here.end};
  addend moved[MOST_ADDENDS];
  if (of && (of->then->starts || !of->then->ends || !ends_with_a_kick())) { /* else the forces are stored */
    inside = overlap(here, of->own);
    inside.first = (inside.first + ALIGNED_NUMBERS - 1) / ALIGNED_NUMBERS * ALIGNED_NUMBERS;
    inside.end = between(inside.first, inside.end / ALIGNED_NUMBERS * ALIGNED_NUMBERS, inside.end);
  }
  for (long long i = 0; i < between(here.first, inside.first, here.end) - here.first; i++)
    row[i] = plus(row[i], by, added, addends, i);
  for (long long i = between(here.first, inside.end, here.end) - here.first; i < here.end - here.first; i++)
    row[i] = plus(row[i], by, added, addends, i);
  if (inside.first == inside.end)
    return;
  const section before = {of->own.first, inside.first};
  if (before.first < before.end)
    continue_section(of->run, of->work, before, *of->then);
  for (int k = 0; k < addends; k++)
    moved[k] = (addend){added[k].values + (inside.first - here.first), added[k].sign};
  continue_part(of->run, of->work, inside, *of->then, by, moved, addends, FRESH);
  of->own.first = inside.end;
}

/* Adds the forces of a block, in parts, and continues its rows, but for the first and the last ones. */
static void sweep_block(sweep *of, long long block)
{
  const section rows = block_of(of, block);
  const long long inner = (of->array[0].end - of->array[0].first) / of->rows;
  const long long few = CHUNKED_ROWS ? rows.end - rows.first : SECTION / (inner + 1) + 1;
  of->own = (section){rows.first + REACH, rows.end - REACH};
  for (long long first = rows.first, end; first < rows.end; first = end) {
    end = first + few < rows.end ? first + few : rows.end;
    const section here = {first, end};
    add_rows(of, here);
    const section done = {of->own.first, end - REACH};
    if (done.end > done.first) {
      treat_rows(of, done, 1);
      of->own.first = done.end;
    }
  }
}

static void sweep_even(sweep *of, long long block)
{
  const section rows = block_of(of, block), all = {rows.first - REACH, rows.end + REACH};
  treat_rows(of, all, 0);
  sweep_block(of, block);
}

/* An odd block, whose neighbours are done, and the rows between it and these. */
static void sweep_odd(sweep *of, long long block)
{
  const section rows = block_of(of, block), inside = {rows.first + REACH, rows.end - REACH};
  const section before = {rows.first - REACH, rows.first + REACH}, behind = {rows.end - REACH, rows.end + REACH};
  treat_rows(of, inside, 0);
  sweep_block(of, block);
  treat_rows(of, before, 1);
  treat_rows(of, behind, 1);
}

/* All rows as one block, whose ends are last. */
static int sweep_alone(sweep *of)
{
  const section all = {0, of->rows}, first = {0, BORDER};
  of->own = (section){BORDER, of->rows - REACH};
  prepare_rows(of, all);
  add_rows(of, all);
  const section last = {of->own.first, of->rows};
  continue_section(of->run, of->work, last, *of->then);
  continue_section(of->run, of->work, first, *of->then);
  return 1;
}

/* Adds `by` times the forces at X to F, and continues all coordinates, `backward` from the last block; returns 0 if
 * there are too few rows. */
static int kick_by_rows(const run_memory *run, const problem *arrays, const work_arrays *work, const double *X,
    double t, double by, double *F, const continuation *then, int backward)
{
  sweep of = {.run = run, .arrays = arrays, .work = work, .X = X, .t = t, .by = by, .F = F, .then = then};
  of.how = share_rows(run, arrays, work->n), of.rows = rows_of(arrays);
  const long long blocks = of.how.blocks;
  if (FUSED && blocks == 1 && threads_of(run) == 1 && of.rows >= 2 * BORDER)
    return sweep_alone(&of);
  if (blocks == 1 || (of.how.of.end - of.how.of.first) / blocks < 2 * REACH)
    return 0;
  describe_coordinate_arrays(arrays, of.array);
  wait_at_barrier(run);
  const section pairs = share_of(run, blocks / 2);
  for (long long k = 0; k < pairs.end - pairs.first; k++) {
    const long long even = 2 * (backward ? pairs.end - 1 - k : pairs.first + k);
    sweep_even(&of, even);
    if (k > 0)
      sweep_odd(&of, backward ? even + 1 : even - 1);
  }
  wait_at_barrier(run);
  if (pairs.first < pairs.end)
    sweep_odd(&of, 2 * pairs.end - 1);
  return 1;
}
