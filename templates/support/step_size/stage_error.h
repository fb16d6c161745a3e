#include "../core/step.h"
#include "../newton/band.h"

/* Error estimate of a step by Newton's method from the leading coefficient of its curve, as in curve_error.h. Requires:
 * stages.h, the tables STAGE_HIGHEST, STAGE_NEXT, STAGE_CURVATURE and STAGE_OTHER_CURVATURE; STAGE_POWER. */

/* Returns the estimate from the unknowns z of the stages, or `least` if that is larger. */
static real stage_error(const step_data *step, const real *z, const real *dq, real share, real decay, real least)
{
  real largest = 0, fastest = 0;
  for (int i = 0; i < M; i++) {
    largest = larger(largest, MATH(fabs)(step->q0[i]) + MATH(fabs)(dq[i]));
    fastest = larger(fastest, MATH(fabs)(dq[i]));
  }
  const real rounded = SITES > M ? largest : fastest; /* constraints hold to rounding, however short the step */
  for (int i = 0; i < M; i++) {
    const real unit = step->h / (MATH(fabs)(step->q0[i]) + MATH(fabs)(dq[i]) + share * largest + REAL_MIN);
    real top = 0, next = 0, curvature = 0, other = 0, noise = 0;
    for (int b = 0; b < B; b++) {
      top += STAGE_HIGHEST[b] * z[i * B + b];
      next += STAGE_NEXT[b] * z[i * B + b];
      noise += CURVE_NOISE * MATH(fabs)(STAGE_HIGHEST[b]);
      curvature += STAGE_CURVATURE[b] * z[i * B + b];
      other += STAGE_OTHER_CURVATURE[b] * z[i * B + b];
    }
    top = MATH(fabs)(top);
    top = top > VANISHING * MATH(fabs)(next) ? larger(top, decay * MATH(fabs)(next)) : top;
    noise *= rounded / MATH(fabs)(step->h);
    top = top < noise ? 0 : SITES > M ? (top - noise) * unit
                                      : top * unit;
    curvature = MATH(fabs)(unit) * (MATH(fabs)(curvature) + MATH(fabs)(other)) + NEGLIGIBLE;
    if (top * top > least * curvature)
      least = top * top / curvature;
  }
  return least;
}

#define UNBENT REAL(1e-11) /* leading coefficients of the velocities of a free flight relative to their change */

/* Returns 1 if the force on some coordinate is nearly constant along the stages, as in free flight. */
static SELDOM int stages_fly(const real *z)
{
  for (int i = 0; i < M; i++) {
    real bend = 0, slope = 0;
    for (int b = 0; b < B; b++) {
      bend += STAGE_HIGHEST[b] * z[i * B + b];
      slope += STAGE_CURVATURE[b] * z[i * B + b];
    }
    if (MATH(fabs)(bend) <= UNBENT * MATH(fabs)(slope))
      return 1;
  }
  return 0;
}
