/* Sparsity pattern of G M^-1 G^T below its diagonal, by rows: which constraints act on the same coordinates. Requires:
 * constraint_output.h, list_coordinates. */

/* For each constraint its first entry; for each entry its coordinate (place) and constraint (owner); for each
 * coordinate its first entry (at) in `list`, ordered by constraint; for each row its first pair, for each pair its
 * column; `where` is the index of each column in the row being processed, -1 if absent. */
typedef struct {
  int *first, *place, *owner, *list, *at, *where, *row, *column;
} pattern;

static pattern pattern_of(const run_memory *run, long long n)
{
  const long long count = run->constraints, entries = run->entries;
  pattern of = {.first = run->places, .column = run->columns};
  of.place = of.first + count + 1;
  of.owner = of.place + entries;
  of.list = of.owner + entries;
  of.at = of.list + entries;
  of.where = of.at + n + 1;
  of.row = of.where + count;
  return of;
}

static void list_entries(const pattern *of, long long count, long long entries, long long n)
{
  memset(of->at, 0, sizeof(int) * (size_t)(n + 1));
  for (long long e = 0; e < entries; e++)
    of->at[of->place[e] + 1]++;
  for (long long i = 0; i < n; i++)
    of->at[i + 1] += of->at[i];
  for (long long k = 0; k < count; k++)
    for (int e = of->first[k]; e < of->first[k + 1]; e++) {
      of->owner[e] = (int)k;
      of->list[of->at[of->place[e]]++] = e;
    }
  for (long long i = n; i > 0; i--) /* each was advanced to the first of the next */
    of->at[i] = of->at[i - 1];
  of->at[0] = 0;
}

static void sort_ascending(int *numbers, long long count)
{
  for (long long k = 1; k < count; k++) {
    const int number = numbers[k];
    long long place = k;
    for (; place > 0 && numbers[place - 1] > number; place--)
      numbers[place] = numbers[place - 1];
    numbers[place] = number;
  }
}

/* Finds the columns of a row, stored from index `pairs` on; returns the total number of pairs. */
static long long find_row(const pattern *of, int k, long long pairs)
{
  const long long begin = pairs;
  of->row[k] = (int)pairs;
  for (int e = of->first[k]; e < of->first[k + 1]; e++)
    for (int m = of->at[of->place[e]]; m < of->at[of->place[e] + 1]; m++) {
      const int l = of->owner[of->list[m]];
      if (l >= k)
        break;
      if (of->where[l] == k)
        continue;
      of->where[l] = k;
      if (of->column)
        of->column[pairs] = l;
      pairs++;
    }
  if (of->column)
    sort_ascending(of->column + begin, pairs - begin);
  return pairs;
}

long long NAME(constraint_pairs)(run_memory *run, const problem *given)
{
  const long long n = NAME(coordinates)(given), count = run->constraints;
  const pattern of = pattern_of(run, n);
  condition now = {.first = of.first, .place = of.place};
  long long pairs = 0;
  list_coordinates(given, &now);
  of.first[count] = (int)now.entries;
  list_entries(&of, count, now.entries, n);
  for (long long k = 0; k < count; k++)
    of.where[k] = -1;
  for (int k = 0; k < count; k++)
    pairs = find_row(&of, k, pairs);
  of.row[count] = (int)pairs;
  for (long long k = 0; k < count; k++)
    of.where[k] = -1;
  return pairs;
}
