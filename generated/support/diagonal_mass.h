/* The masses are diagonal. Before it: points.h or trajectories.h. */
enum { DIAGONAL = 1,
  MASS = M };

/* 1 / mass, which is divided while forces are computed: a division of what comes of them would be waited for. */
static inline void factor_mass(lanes *mass)
{
  for (int i = 0; i < M; i++)
    mass[i] = 1.0 / mass[i];
}

/* r = mass^-1 r in every lane, with the factors of the mass. */
static inline void solve_mass(const lanes *mass, lanes *r)
{
  for (int i = 0; i < M; i++)
    r[i] *= mass[i];
}
