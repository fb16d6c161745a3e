/* What the curve of a step leaves unresolved. Before it: a sweep, the table HIGHEST; KEPT, how many numbers are kept of
 * a coordinate, KEPT_VELOCITIES, whether they are velocities, KEPT_UNIT(i), what they move coordinate i by on a step,
 * and RESOLVED, what makes the highest coefficient that of the curve's accelerations. */

/* Of each coordinate, with everything as a part of its size: the square of what the highest coefficient moves it by,
 * over what the curve bends it by. To its size is added `share` of the largest: EACH where each is to be exact by
 * itself, ALL where the state is. Returned is the largest of these, or `least` if that is larger. */
static double curve_error(const step_data *step, const sweep_data *data, const double *memory, const double *dq,
    double share, double least)
{
  double largest = 0.0;
  for (int i = 0; i < M; i++)
    largest = larger(largest, fabs(step->q0[i]) + fabs(dq[i]));
  for (int i = 0; i < M; i++) {
    const double *x = memory + i * LANES;
    const double size = fabs(step->q0[i]) + fabs(dq[i]) + share * largest + DBL_MIN;
    const double ends = KEPT_VELOCITIES ? fabs(x[KEPT - 1] - x[0]) + fabs(x[KEPT / 2] - x[0])
                                        : fabs(x[0]) + fabs(x[KEPT - 1]);
    const double bend = (fabs(KEPT_UNIT(i)) * ends + NEGLIGIBLE * size) * size;
    lanes all;
    double top;
    memcpy(&all, x, sizeof all);
    top = RESOLVED * KEPT_UNIT(i) * lanes_total(HIGHEST * all);
    if (top * top > least * bend)
      least = top * top / bend;
  }
  (void)data;
  return least;
}
