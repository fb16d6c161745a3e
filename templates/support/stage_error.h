/* What the curve of the stages of Newton's iteration leaves unresolved, as curve_error.h says. Before it: stages.h, the
 * table STAGE_HIGHEST. */

/* z: velocities of the stages. */
static real stage_error(const step_data *step, const real *z, const real *dq, real least)
{
  real largest = 0;
  for (int i = 0; i < M; i++)
    largest = larger(largest, MATH(fabs)(step->q0[i]) + MATH(fabs)(dq[i]));
  for (int i = 0; i < M; i++) {
    const real *v = z + i * B;
    const real unit = step->h / (MATH(fabs)(step->q0[i]) + MATH(fabs)(dq[i]) + REAL_EPSILON * largest + REAL_MIN);
    const real bend = MATH(fabs)(unit) * (MATH(fabs)(v[B - 1] - v[0]) + MATH(fabs)(v[B / 2] - v[0])) + NEGLIGIBLE;
    real top = 0;
    for (int b = 0; b < B; b++)
      top += (4 * B - 6) * unit * STAGE_HIGHEST[b] * v[b];
    if (top * top > least * bend)
      least = top * top / bend;
  }
  return least;
}
