/* Which constraints act on the same coordinates: the pattern of G M^-1 G^T below its diagonal, row by row. Before it:
 * held.h, find_places. */

/* Of constraints the first of their entries, of entries their coordinate and their constraint; of coordinates the first
 * of their entries, which are listed with ascending constraints; of rows their first pair, of pairs their column; and
 * where the columns of a row are while it is worked on, -1 of others. */
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
  for (long long i = n; i > 0; i--) /* each was moved on to the first of the next */
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

/* The columns of a row behind so many pairs; returned is the number of pairs with these. */
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
  find_places(given, &now);
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
