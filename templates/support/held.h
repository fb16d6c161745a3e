/* Constraints at every element of loops. Before it: indexed.h. */

/* Where what is found at the next element goes: g, g_t and the slopes of g, or the first of its entries and on which
 * coordinates they act. */
typedef struct {
  double *g, *rate, *slope;
  int *first, *place;
  long long count, entries;
} condition;
