/* How a step by coupled_sweep.h changes with what it starts from, and the transpose, by sweeps again. With A and W the
 * tables that make positions of velocities and momenta of forces, the changes x, v, f, p of all these at the points
 * are
 *   x = x0 + h A v,        f = L_qq x + L_qv v,        p = p0 + h W f,        v = L_vv^-1 (p - L_vq x),
 * and the slopes of a number by them, the other way, are the same but for transposes, with y for f, z for x, w for p:
 *   y = y0 + h W^T w,      z = L_qq y - L_qv w,        v = v0 + h A^T z,      w = L_vv^-1 (v + L_vq y).
 * All are exact: those of the map which the equations define. Before it: coupled_sweep.h, changes_at_rest.h;
 * CHANGE_POSITION, A, and CHANGE_MOMENTUM, W, and with _BACK their transposes; the kernels point_slopes, by_slopes,
 * BY_SLOPES_BACK; POINT_GIVEN and given_slopes. */

enum {
  KEPT_OF_STEP = M * (POINTS + 2), /* numbers: velocities, then the increments of q and p */
  GIVEN_T = GIVEN - 2
};

/* A solved step: its increments, how its points stand from (q0, p0), room for x and v and behind it the slopes of
 * forces and momenta by these; those by what is given; factors of masses. */
typedef struct {
  const step_data *step;
  const double *dq, *dp;
  lanes D[GROUPS][M], E[GROUPS][M], u[GROUPS][2 * M + POINT_SLOPES], given[GROUPS][GIVEN_SLOPES], mass[GROUPS][MASS];
  weight end_position[GROUPS], end_momentum[GROUPS];
} swept_step;

/* What is told of a step from its increments and the velocities it keeps. */
static void keep_step(const step_data *step, const sweep_data *data, const double *memory, const double *dq,
    const double *dp, double *to)
{
  (void)step, (void)data;
  memcpy(to, memory, sizeof(double) * M * POINTS);
  memcpy(to + M * POINTS, dq, sizeof(double) * M);
  memcpy(to + M * (POINTS + 1), dp, sizeof(double) * M);
}

static __attribute__((noinline)) void slopes_of_step(const step_data *step, const sweep_data *data,
    const double *told, swept_step *at)
{
  lanes V[GROUPS][M], value[M + POINT_SLOPES];
  at->step = step;
  at->dq = told + M * POINTS;
  at->dp = at->dq + M;
  lanes_load(told, V);
  for (int n = 0; n < GROUPS; n++) {
    const lanes t = step->t + step->h * ABSCISSA[n];
    lanes u[2 * M];
    at->end_position[n] = POINT_END_POSITION[n] * data->position_weight[n];
    at->end_momentum[n] = POINT_END_MOMENTUM[n] * data->momentum_weight[n];
    for (int i = 0; i < M; i++) {
      at->D[n][i] = step->h * apply(CHANGE_POSITION, n, V, i);
      u[i] = step->q0[i] + at->D[n][i];
      u[M + i] = V[n][i];
    }
    memset(at->mass[n], 0, sizeof at->mass[n]);
    point_slopes(u, t, step->parameters, value, at->mass[n]);
    factor_mass(at->mass[n]);
    for (int i = 0; i < M; i++)
      at->E[n][i] = value[i] - step->p0[i];
    memcpy(at->u[n] + 2 * M, value + M, sizeof(lanes) * POINT_SLOPES);
    given_slopes(u, t, step->parameters, at->given[n]);
  }
}

/* The changes of positions by those of velocities v (back: of forces by those of momenta), from x0; what both make of
 * the next, f and a part of p. */
static inline void place_changes(swept_step *at, int back, lanes (*x0)[M], lanes (*v)[M], lanes (*f)[2 * M])
{
  const step_data *step = at->step;
  const lanes *table = back ? CHANGE_MOMENTUM_BACK : CHANGE_POSITION;
  for (int n = 0; n < GROUPS; n++) {
    for (int i = 0; i < M; i++)
      at->u[n][i] = x0[n][i] + step->h * apply(table, n, v, i);
    memcpy(at->u[n] + M, v[n], sizeof v[n]);
    (back ? BY_SLOPES_BACK : by_slopes)(at->u[n], lanes_of(step->t), step->parameters, f[n]);
  }
}

/* f and v from their first parts, x0 and p0 (back: z and w from y0 and v0); x and v (y and w) stand in u, f behind.
 * Measured by the masses, as are kinetic energies: whatever the units of coordinates. */
static inline int settle(swept_step *at, int back, lanes (*x0)[M], lanes (*p0)[M], lanes (*f)[2 * M], int *look)
{
  const lanes *table = back ? CHANGE_POSITION_BACK : CHANGE_MOMENTUM;
  lanes v[GROUPS][M], F[GROUPS][M], p[GROUPS][M];
  sweep_changes past = {INFINITY, INFINITY};
  int status = 0;
  memset(v, 0, sizeof v);
  memset(p, 0, sizeof p);
  place_changes(at, back, x0, v, f);
  for (int k = 0; status == 0; k++) {
    lanes moved[GROUPS], size[GROUPS];
    for (int n = 0; n < GROUPS; n++)
      memcpy(F[n], f[n], sizeof F[n]);
    for (int n = 0; n < GROUPS; n++) {
      lanes next[M], before[M];
      moved[n] = size[n] = lanes_of(0.0);
      memcpy(before, p[n], sizeof before);
      for (int i = 0; i < M; i++)
        next[i] = p[n][i] = p0[n][i] + at->step->h * apply(table, n, F, i) + f[n][M + i];
      solve_mass(at->mass[n], next);
      for (int i = 0; i < M; i++) {
        moved[n] += (p[n][i] - before[i]) * (next[i] - v[n][i]);
        size[n] += p[n][i] * next[i];
        v[n][i] = next[i];
      }
    }
    if (k >= *look)
      status = changes_rest(fabs(points_total(moved)), fabs(points_total(size)), &past, k, look);
    place_changes(at, back, x0, v, f);
  }
  return status == 1 ? OK : NOT_CONVERGED;
}

/* The changes of forces and momenta, points held. */
static inline void given_changed(const swept_step *at, const double *v, lanes (*F)[2 * M])
{
  memset(F, 0, sizeof(lanes) * GROUPS * 2 * M);
  for (int n = 0; n < GROUPS; n++)
    for (int e = 0; e < GIVEN_SLOPES; e++) {
      const int from = 2 * M + POINT_GIVEN[e][1];
      const lanes by = from == GIVEN_T ? v[GIVEN_T] + v[GIVEN_T + 1] * ABSCISSA[n] : lanes_of(v[from]);
      F[n][POINT_GIVEN[e][0]] += at->given[n][e] * by;
    }
}

/* v, changes of (q0, p0, parameters, t, h), become those of (q1, p1, parameters, t + h, h). */
static __attribute__((noinline)) int push_swept(swept_step *at, double *v, int *look)
{
  const double h = at->step->h, dh = v[GIVEN_T + 1] / h;
  lanes given[GROUPS][2 * M], x0[GROUPS][M], p0[GROUPS][M], f[GROUPS][2 * M], F[GROUPS][M];
  given_changed(at, v, given);
  for (int n = 0; n < GROUPS; n++)
    memcpy(F[n], given[n], sizeof F[n]);
  for (int n = 0; n < GROUPS; n++)
    for (int i = 0; i < M; i++) {
      x0[n][i] = v[i] + dh * at->D[n][i];
      p0[n][i] = v[M + i] + dh * at->E[n][i] + h * apply(CHANGE_MOMENTUM, n, F, i) - given[n][M + i];
    }
  if (settle(at, 0, x0, p0, f, look) != OK)
    return NOT_CONVERGED;
  for (int i = 0; i < M; i++) {
    lanes moved[GROUPS], pushed[GROUPS];
    for (int n = 0; n < GROUPS; n++) {
      moved[n] = at->end_position[n] * at->u[n][M + i];
      pushed[n] = at->end_momentum[n] * (f[n][i] + given[n][i]);
    }
    v[i] += dh * at->dq[i] + points_total(moved);
    v[M + i] += dh * at->dp[i] + points_total(pushed);
  }
  v[GIVEN_T] += v[GIVEN_T + 1];
  return OK;
}

/* What slopes by forces and momenta, in u, come to, by what else these depend on: added to v. */
static inline void given_back(const swept_step *at, double *v)
{
  lanes by[GIVEN - 2 * M][GROUPS];
  memset(by, 0, sizeof by);
  for (int n = 0; n < GROUPS; n++)
    for (int e = 0; e < GIVEN_SLOPES; e++) {
      const int from = POINT_GIVEN[e][0], to = POINT_GIVEN[e][1];
      const lanes part = at->given[n][e] * at->u[n][from];
      by[to][n] += from < M ? part : -part;
      if (to == GIVEN_T - 2 * M)
        by[to + 1][n] += ABSCISSA[n] * (from < M ? part : -part);
    }
  for (int j = 0; j < GIVEN - 2 * M; j++)
    v[2 * M + j] += points_total(by[j]);
}

/* v, slopes by (q1, p1, parameters, t + h, h), become those by (q0, p0, parameters, t, h): the transpose. */
static __attribute__((noinline)) int pull_swept(swept_step *at, double *v, int *look)
{
  double by_h = 0.0;
  lanes y0[GROUPS][M], v0[GROUPS][M], z[GROUPS][2 * M];
  for (int n = 0; n < GROUPS; n++)
    for (int i = 0; i < M; i++) {
      y0[n][i] = at->end_momentum[n] * v[M + i];
      v0[n][i] = at->end_position[n] * v[i];
    }
  if (settle(at, 1, y0, v0, z, look) != OK)
    return NOT_CONVERGED;
  v[GIVEN_T + 1] += v[GIVEN_T];
  given_back(at, v);
  for (int i = 0; i < M; i++) {
    lanes placed[GROUPS], pushed[GROUPS], grown[GROUPS];
    for (int n = 0; n < GROUPS; n++) {
      placed[n] = z[n][i];
      pushed[n] = at->u[n][M + i];
      grown[n] = z[n][i] * at->D[n][i] + at->u[n][M + i] * at->E[n][i];
    }
    by_h += v[i] * at->dq[i] + v[M + i] * at->dp[i] + points_total(grown);
    v[i] += points_total(placed);
    v[M + i] += points_total(pushed);
  }
  v[GIVEN_T + 1] += by_h / at->step->h;
  return OK;
}
