#include "arrays.h"

/* Kicks in one pass over the rows of lattices, the elements with the same first index. Forces couple rows at most REACH
 * apart, so that a row is continued as soon as those of the next rows are added. Blocks of rows are the tasks of the
 * forces: even ones before their odd neighbours, as in add_forces, so that sums round alike. Requires: arrays.h,
 * continue_section, CHUNK, REACH, CHUNKED_ROWS (rows are the innermost loop), BEFORE_CHUNKS (rows before the chunks of
 * values in the first block), rows_of, share_rows, describe_coordinate_arrays; add_rows, which adds the forces that
 * couple rows, prepare_rows and complete_rows, which add others before and behind. */
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
} sweep;

static void prepare_rows(const sweep *of, section rows);
static void add_rows(const sweep *of, section rows);
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

/* Adds the forces of a block, in parts that begin with a chunk of values, and continues its rows, but for the first and
 * the last ones. */
static void sweep_block(const sweep *of, long long block)
{
  const section rows = block_of(of, block);
  const long long inner = (of->array[0].end - of->array[0].first) / of->rows;
  const long long few = CHUNKED_ROWS ? CHUNK : SECTION / (inner + 1) + 1;
  long long end = part_of(of->how.of, block, of->how.blocks).first + (block == 0) * BEFORE_CHUNKS;
  section done = {rows.first + REACH, rows.first + REACH};
  for (long long first = rows.first; first < rows.end; first = end) {
    end = end + few < rows.end ? end + few : rows.end;
    const section here = {first, end};
    add_rows(of, here);
    done.end = end - REACH;
    if (done.end > done.first) {
      treat_rows(of, done, 1);
      done.first = done.end;
    }
  }
}

static void sweep_even(const sweep *of, long long block)
{
  const section rows = block_of(of, block), all = {rows.first - REACH, rows.end + REACH};
  treat_rows(of, all, 0);
  sweep_block(of, block);
}

/* An odd block, whose neighbours are done, and the rows between it and these. */
static void sweep_odd(const sweep *of, long long block)
{
  const section rows = block_of(of, block), inside = {rows.first + REACH, rows.end - REACH};
  const section before = {rows.first - REACH, rows.first + REACH}, behind = {rows.end - REACH, rows.end + REACH};
  treat_rows(of, inside, 0);
  sweep_block(of, block);
  treat_rows(of, before, 1);
  treat_rows(of, behind, 1);
}

/* Adds `by` times the forces at X to F, and continues all coordinates; returns 0 if there are too few rows. */
static int kick_by_rows(const run_memory *run, const problem *arrays, const work_arrays *work, const double *X,
    double t, double by, double *F, const continuation *then)
{
  sweep of = {.run = run,
      .arrays = arrays,
      .work = work,
      .X = X,
      .t = t,
      .by = by,
      .F = F,
      .then = then,
      .how = share_rows(run, arrays, work->n),
      .rows = rows_of(arrays)};
  const long long blocks = of.how.blocks;
  if (blocks == 1 || (of.how.of.end - of.how.of.first) / blocks < 2 * REACH)
    return 0;
  describe_coordinate_arrays(arrays, of.array);
  wait_at_barrier(run);
  const section pairs = share_of(run, blocks / 2);
  if (pairs.first < pairs.end)
    sweep_even(&of, 2 * pairs.first);
  for (long long k = pairs.first; k + 1 < pairs.end; k++) {
    sweep_even(&of, 2 * k + 2);
    sweep_odd(&of, 2 * k + 1);
  }
  wait_at_barrier(run);
  if (pairs.first < pairs.end)
    sweep_odd(&of, 2 * pairs.end - 1);
  return 1;
}
