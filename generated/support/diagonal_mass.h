/* The masses are diagonal: nothing to factorise. Before it: points.h or trajectories.h. */
enum { DIAGONAL = 1,
  MASS = M };

static inline void factor_mass(lanes *mass)
{
  (void)mass;
}

/* r = mass^-1 r in every lane. */
static inline void solve_mass(const lanes *mass, lanes *r)
{
  for (int i = 0; i < M; i++)
    r[i] /= mass[i];
}
