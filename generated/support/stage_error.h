/* What the curve of the stages of Newton's iteration leaves unresolved, as curve_error.h says. Before it: stages.h, the
 * table STAGE_HIGHEST. */

/* z: velocities of the stages. */
static double stage_error(const step_data *step, const double *z, const double *dq, double least)
{
  double largest = 0.0;
  for (int i = 0; i < M; i++)
    largest = larger(largest, fabs(step->q0[i]) + fabs(dq[i]));
  for (int i = 0; i < M; i++) {
    const double *v = z + i * B;
    const double unit = step->h / (fabs(step->q0[i]) + fabs(dq[i]) + DBL_EPSILON * largest + DBL_MIN);
    const double bend = fabs(unit) * (fabs(v[B - 1] - v[0]) + fabs(v[B / 2] - v[0])) + 1e-12;
    double top = 0.0;
    for (int b = 0; b < B; b++)
      top += (4 * B - 6) * unit * STAGE_HIGHEST[b] * v[b];
    if (top * top > least * bend)
      least = top * top / bend;
  }
  return least;
}
