#include "../core/shifts.h"

/* Linear part of the forces, F(q) = -K q + .. with constant K, solved implicitly: the correction d of the points X by
 * their residual r is the solution of (1 + h^2 P (x) M^-1 K) d = r, a simplified Newton iteration, so that fast linear
 * vibrations limit neither convergence nor the step size (E. Hairer & G. Wanner, Solving ODEs II, sec. IV.8). Its
 * systems m + mu h^2 K are complex symmetric band matrices, factored as L D L^T once for each step size; D^-1 on the
 * diagonal. Requires: LINEAR_ENTRIES and LINEAR_ENTRY of -K, i >= j in the order of LINEAR_COORDINATE; LINEAR_BAND,
 * their largest distance; and linear_forces, the derivatives of the forces at q = 0. */

#define FAST_VIBRATIONS 16.0 /* (h omega)^2, from which on the iteration of all forces takes longer */

typedef struct {
  int is_used;
  complex_shifts row[M][LINEAR_BAND + 1]; /* of L: entry i - j */
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
    all->row[i][0].re += all->mass[i];
  for (int e = 0; e < LINEAR_ENTRIES; e++) {
    const double entry = -square * all->stiffness[e];
    complex_shifts *at = &all->row[LINEAR_ENTRY[e][0]][LINEAR_ENTRY[e][0] - LINEAR_ENTRY[e][1]];
    at->re += entry * mu.re, at->im += entry * mu.im;
  }
  for (int i = 0; i < M; i++) {
    const int first = least(i, LINEAR_BAND); /* coupled places before */
    complex_shifts *row = all->row[i], pivot = row[0];
    for (int d = first; d > 0; d--) /* L D, then L */
      for (int k = d + 1; k <= first; k++)
        row[d] = minus_product(row[d], row[k], all->row[i - d][k - d]);
    for (int d = first; d > 0; d--) {
      const complex_shifts scaled = product_of(row[d], all->row[i - d][0]);
      pivot = minus_product(pivot, row[d], scaled);
      row[d] = scaled;
    }
    row[0] = inverse_of_shifts(pivot);
  }
}

/* Replaces the residuals of the points by their corrections. */
static void solve_linear_part(const linear_part *all, lanes *r)
{
  complex_shifts z[M];
  for (int i = 0; i < M; i++) {
    z[i] = into_shifts(r + LINEAR_COORDINATE[i], M, all->mass[i]);
    for (int d = least(i, LINEAR_BAND); d > 0; d--)
      z[i] = minus_product(z[i], all->row[i][d], z[i - d]);
  }
  for (int i = M - 1; i >= 0; i--) {
    z[i] = product_of(z[i], all->row[i][0]);
    for (int d = 1; d <= LINEAR_BAND && i + d < M; d++)
      z[i] = minus_product(z[i], all->row[i + d][d], z[i + d]);
    from_shifts(z[i], M, r + LINEAR_COORDINATE[i]);
  }
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
