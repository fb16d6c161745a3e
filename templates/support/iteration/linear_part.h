#include "../core/shifts.h"
#define COMPLEX_SYSTEMS
#include "../core/symmetric.h"

/* Linear part of the forces, F(q) = -K q + .. with constant K, solved implicitly: the correction d of the points X by
 * their residual r is the solution of (1 + h^2 P (x) M^-1 K) d = r, a simplified Newton iteration, so that fast linear
 * vibrations limit neither convergence nor the step size (E. Hairer & G. Wanner, Solving ODEs II, sec. IV.8). Its
 * systems m + mu h^2 K are complex symmetric band matrices, factored once for each step size. Requires: LINEAR_ENTRIES
 * and LINEAR_ENTRY of -K, i >= j in the order of LINEAR_COORDINATE; LINEAR_BAND, their largest distance; and
 * linear_forces, the derivatives of the forces at q = 0. */

#define FAST_VIBRATIONS 16.0 /* (h omega)^2, from which on the iteration of all forces takes longer */

typedef struct {
  int is_used;
  complex_shifts row[M * (LINEAR_BAND + 1)]; /* of L */
  double stiffness[LINEAR_ENTRIES], mass[M]; /* mass by places */
} linear_part;

static void factorise_linear_part(const double *parameters, double square, const double *inverse_mass, linear_part *all)
{
  const complex_shifts mu = {shifts_at(MU), shifts_at(MU + SHIFTS)};
  double sum[M] = {0.0}, fastest = 0.0;
  linear_forces(NULL, 0.0, parameters, all->stiffness);
  for (int e = 0; e < LINEAR_ENTRIES; e++) {
    const int i = LINEAR_ENTRY[e][0], j = LINEAR_ENTRY[e][1];
    sum[i] += fabs(all->stiffness[e]);
    sum[j] += i == j ? 0.0 : fabs(all->stiffness[e]);
  }
  for (int i = 0; i < M; i++) {
    all->mass[i] = 1.0 / inverse_mass[LINEAR_COORDINATE[i]];
    fastest = larger(fastest, square * sum[i] / fabs(all->mass[i]));
  }
  all->is_used = fastest > FAST_VIBRATIONS;
  if (!all->is_used)
    return;
  memset(all->row, 0, sizeof all->row);
  for (int i = 0; i < M; i++)
    all->row[(i + 1) * (LINEAR_BAND + 1) - 1].re += all->mass[i];
  for (int e = 0; e < LINEAR_ENTRIES; e++) {
    const double entry = -square * all->stiffness[e];
    complex_shifts *at = &all->row[LINEAR_BAND + LINEAR_ENTRY[e][0] * LINEAR_BAND + LINEAR_ENTRY[e][1]];
    at->re += entry * mu.re, at->im += entry * mu.im;
  }
  factorise_symmetric(all->row, M, LINEAR_BAND, LINEAR_BAND);
}

/* Replaces the residuals of the points by their corrections. */
static void solve_linear_part(const linear_part *all, lanes *r)
{
  complex_shifts z[M];
  for (int i = 0; i < M; i++)
    z[i] = into_shifts(r + LINEAR_COORDINATE[i], M, all->mass[i]);
  solve_symmetric(all->row, M, LINEAR_BAND, LINEAR_BAND, z);
  for (int i = 0; i < M; i++)
    from_shifts(z[i], M, r + LINEAR_COORDINATE[i]);
}

/* F -= K d: the forces at points corrected by d. */
static void correct_forces(const linear_part *all, const lanes *d, lanes *F)
{
  for (int e = 0; e < LINEAR_ENTRIES; e++) {
    const int i = LINEAR_COORDINATE[LINEAR_ENTRY[e][0]], j = LINEAR_COORDINATE[LINEAR_ENTRY[e][1]];
    for (int g = 0; g < GROUPS; g++) {
      F[g * M + i] += all->stiffness[e] * d[g * M + j];
      if (i != j)
        F[g * M + j] += all->stiffness[e] * d[g * M + i];
    }
  }
}
