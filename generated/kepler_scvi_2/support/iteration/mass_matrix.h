#ifndef SUPPORT_MASS_MATRIX_H
#define SUPPORT_MASS_MATRIX_H

/* Linear systems with the mass matrix in every lane, which is diagonal (DIAGONAL_MASS) or full. */
/* Diagonal mass matrices. Requires: points.h or trajectories.h. */
enum { DIAGONAL = 1,
  MASS = M };

/* Inverts the masses; the division overlaps with the evaluation of the forces. */
static inline void factor_mass(lanes *mass)
{
  for (int i = 0; i < M; i++)
    mass[i] = 1.0 / mass[i];
}

/* r = mass^-1 r in every lane, with the inverted masses. */
static inline void solve_mass(const lanes *mass, lanes *r)
{
  for (int i = 0; i < M; i++)
    r[i] *= mass[i];
}

#endif
