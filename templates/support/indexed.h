/* Sums over indices: what is integrated, masses, sums with the errors of their sums. Before it: answers.h. */
typedef NAME(problem) problem;
typedef NAME(run) run_memory;

/* A sum, and what rounding cut off it (Knuth). */
typedef struct {
  double sum, rest;
} compensated;

static inline void add_to_sum(compensated *total, double x)
{
  const double sum = total->sum + x, part = sum - total->sum;
  total->rest += (total->sum - (sum - part)) + (x - part);
  total->sum = sum;
}

/* The sum of p^2 / (2 m). */
static void add_kinetic_energy(compensated *total, const double *p, const double *inverse_mass, long long n)
{
  for (long long i = 0; i < n; i++)
    add_to_sum(total, 0.5 * inverse_mass[i] * (p[i] * p[i]));
}

/* The place on a ring that is so far from the first. */
static inline long long place_on_ring(long long place, long long size)
{
  const long long above = place < size ? place : place - size;
  return place < 0 ? place + size : above;
}

/* How far from an index the place `offset` behind it stands, which may go around: the same from begin to end, which is
 * made smaller for that. */
static inline long long around(long long begin, long long offset, long long size, long long *end)
{
  const long long moved = place_on_ring(begin + offset, size) - begin;
  const long long change = offset > 0 ? size - offset : -offset; /* from there on it goes around, or no more */
  if (begin < change && change < *end)
    *end = change;
  return moved;
}

/* Masses to 1 / mass, in place; SINGULAR where one is not positive. */
static int invert_masses(double *mass, long long n)
{
  int faults = 0;
  for (long long i = 0; i < n; i++) {
    faults |= !(mass[i] > 0.0 && mass[i] < INFINITY);
    mass[i] = 1.0 / mass[i];
  }
  return faults ? SINGULAR : OK;
}

/* x + carry += increment + low, in twice the precision (Knuth's error of an addition, then Dekker's). */
static inline void add_compensated(double *x, double *carry, double increment, double low)
{
  const double sum = *x + increment, part = sum - *x;
  const double rest = ((*x - (sum - part)) + (increment - part)) + (*carry + low);
  const double new_x = sum + rest;
  *carry = rest - (new_x - sum);
  *x = new_x;
}
