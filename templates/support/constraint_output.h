/* Output of the kernels of constraints in loops. Requires: arrays.h. */

/* Destinations of the next constraint: g, g_t and the derivatives of g, or the index of its first entry and the
 * coordinates of the entries. */
typedef struct {
  double *g, *rate, *derivative;
  int *first, *place;
  long long count, entries;
} condition;
