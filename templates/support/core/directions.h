#include "numbers.h"

/* Derivatives of a kernel along unit vectors, as many at a time as a register has numbers. */

#ifdef __GNUC__
#include "vector_width.h"
#define WIDTH_OF_DIRECTIONS (VECTOR_BYTES / REAL_BYTES)
typedef real directions __attribute__((vector_size(VECTOR_BYTES)));
#else
#define WIDTH_OF_DIRECTIONS 1
typedef real directions;
#endif

static inline directions directions_of(real x)
{
  const directions zero = {0.0};
  return zero + x;
}

/* Linear function of directions u of the arguments, by local derivatives: the changes of values. */
typedef void tangents(const directions *u, real t, const real *local, directions *change);

/* derivative[k] = d value_i / d u_j for the rows (i, j, k) of entry, in the order of j; x and change are memory. */
static inline void differentiate(tangents *along, int arguments, const real *local, const int (*entry)[3], int count,
    directions *x, directions *change, real *derivative)
{
  for (int first = 0, e = 0; first < arguments; first += WIDTH_OF_DIRECTIONS) {
    const int end = least(first + WIDTH_OF_DIRECTIONS, arguments);
    memset(x, 0, sizeof(directions) * (size_t)arguments);
    for (int j = first; j < end; j++)
      ((real *)(x + j))[j - first] = 1;
    along(x, 0, local, change);
    for (; e < count && entry[e][1] < end; e++)
      derivative[entry[e][2]] = ((const real *)(change + entry[e][0]))[entry[e][1] - first];
  }
}
