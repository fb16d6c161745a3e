/* What the curve of a step leaves unresolved. Before it: a sweep, the tables HIGHEST and NEXT; KEPT, how many numbers are
 * kept of a coordinate, KEPT_VELOCITIES, whether they are velocities, KEPT_UNIT(i), what they move coordinate i by on a
 * step, and RESOLVED and NEXT_RESOLVED, what makes the highest coefficients those of the curve's accelerations. */

/* What the points have in a coefficient of the curve. */
static inline double coefficient(const lanes *table, const double *x)
{
  lanes all[GROUPS];
  memcpy(all, x, sizeof all);
  for (int n = 0; n < GROUPS; n++)
    all[n] *= table[n];
  return points_total(all);
}

/* Of each coordinate, with everything as a part of its size: the square of what the highest coefficient moves it by,
 * over what the curve bends it by. Where that coefficient happens to be less than `decay` times the one below, it is
 * taken for as much: of neighbours one at most passes through zero (0: not looked at). To its size is added `share` of
 * the largest: EACH where each is to be exact by itself, ALL where the state is. Returned is the largest of these, or
 * `least` if that is larger, as it is after most steps: loops of one kind of arithmetic each, which become vectors, say
 * so. */
static inline double curve_error(const step_data *step, const sweep_data *data, const double *memory, const double *dq,
    double share, double decay, double least)
{
  double size[M], top[M], bend[M], added;
  int exceeded = 0;
  for (int i = 0; i < M; i++)
    size[i] = fabs(step->q0[i]) + fabs(dq[i]);
  added = share * largest_number(size) + DBL_MIN;
  for (int i = 0; i < M; i++) {
    const double *x = memory + i * POINTS;
    bend[i] =
        KEPT_VELOCITIES ? fabs(x[KEPT - 1] - x[0]) + fabs(x[KEPT / 2] - x[0]) : fabs(x[0]) + fabs(x[KEPT - 1]);
  }
  for (int i = 0; i < M; i++)
    top[i] = fabs(RESOLVED * coefficient(HIGHEST, memory + i * POINTS));
  for (int i = 0; decay > 0.0 && i < M; i++)
    top[i] = larger(top[i], decay * fabs(NEXT_RESOLVED * coefficient(NEXT, memory + i * POINTS)));
  for (int i = 0; i < M; i++) {
    size[i] += added;
    top[i] *= KEPT_UNIT(i);
    top[i] *= top[i];
    bend[i] = (fabs(KEPT_UNIT(i)) * bend[i] + NEGLIGIBLE * size[i]) * size[i];
    exceeded |= top[i] > least * bend[i];
  }
  for (int i = 0; exceeded && i < M; i++)
    if (top[i] > least * bend[i])
      least = top[i] / bend[i];
  (void)data;
  return least;
}

#define LOOKED_AT 4 /* steps of one length, of which one is asked for a coefficient that happens to be small */

/* The decay where the largest error of many steps is wanted, of which few can be small by chance. */
static inline double now_and_then(const run_memory *run)
{
  return run->step % LOOKED_AT == 0 ? DECAY : 0.0;
}
