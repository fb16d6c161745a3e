/* What the curve of a step leaves unresolved. Before it: a sweep, the table HIGHEST; KEPT, how many numbers are kept of
 * a coordinate, KEPT_VELOCITIES, whether they are velocities, KEPT_UNIT(i), what they move coordinate i by on a step,
 * and RESOLVED, what makes the highest coefficient that of the curve's accelerations. */

/* Of each coordinate, with everything as a part of its size: the square of what the highest coefficient moves it by,
 * over what the curve bends it by. To its size is added `share` of the largest: EACH where each is to be exact by
 * itself, ALL where the state is. Returned is the largest of these, or `least` if that is larger, as it is after most
 * steps: loops of one kind of arithmetic each, which become vectors, say so. */
static inline double curve_error(const step_data *step, const sweep_data *data, const double *memory, const double *dq,
    double share, double least)
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
  for (int i = 0; i < M; i++) {
    lanes all[GROUPS];
    memcpy(all, memory + i * POINTS, sizeof all);
    for (int n = 0; n < GROUPS; n++)
      all[n] *= HIGHEST[n];
    top[i] = points_total(all);
  }
  for (int i = 0; i < M; i++) {
    size[i] += added;
    top[i] *= RESOLVED * KEPT_UNIT(i);
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
