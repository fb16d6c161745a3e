/* Linear systems with the mass matrix in every lane, which is diagonal (DIAGONAL_MASS), known by terms of its inverse
 * (MASS_TERMS), or full. */
#ifdef DIAGONAL_MASS
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
#elif defined(MASS_TERMS)
/* Terms of the inverses of mass matrices. Requires: points.h or trajectories.h, the kernel solve_lanes. */
enum { DIAGONAL = 0,
  MASS = MASS_TERMS };

/* The terms are ready for use. */
#define factor_mass(mass) (void)0

/* r = mass^-1 r in every lane. */
static inline void solve_mass(const lanes *mass, lanes *r)
{
  const weight t = {0.0}; /* and no parameters: the terms contain them */
  lanes u[MASS + M];
  memcpy(u, mass, sizeof(lanes) * MASS);
  memcpy(u + MASS, r, sizeof(lanes) * M);
  solve_lanes(u, t, 0, r);
}
#else
#include "../core/symmetric.h"

/* Full mass matrices in every lane, in their lower triangles. Requires: points.h or trajectories.h. */
enum { DIAGONAL = 0,
  MASS = M * M };

/* Factors of the mass matrix; a zero pivot gives NaN. */
static inline void factor_mass(lanes *mass)
{
  factorise_symmetric(mass, M, M - 1, M);
}

/* r = mass^-1 r with the factors. */
static inline void solve_mass(const lanes *mass, lanes *r)
{
  solve_symmetric(mass, M, M - 1, M, r);
}
#endif
