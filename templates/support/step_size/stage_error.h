#include "../core/sizes.h"
#include "../newton/band.h"

/* Error estimate of a step by Newton's method from the leading coefficient of its curve, as in curve_error.h. Requires:
 * stages.h, the tables STAGE_HIGHEST, STAGE_NEXT, STAGE_CURVATURE and STAGE_OTHER_CURVATURE; STAGE_POWER. */

/* The largest absolute values of sums over the unknowns of a coordinate. */
static inline real curvature_of_stages(const step_data *step, const real *z, int i)
{
  real curvature = 0, other = 0;
  for (int b = 0; b < B; b++) {
    curvature += STAGE_CURVATURE[b] * z[i * B + b];
    other += STAGE_OTHER_CURVATURE[b] * z[i * B + b];
  }
  return MATH(fabs)(step->h) * (MATH(fabs)(curvature) + MATH(fabs)(other)) / 2;
}

/* Of each coordinate: the motion, displacements by the curvature and by the rounding of forces; the largest motion. */
typedef struct {
  real size[M], curvature[M], rounding[M], largest;
} stage_sizes;

/* Returns the estimate from the unknowns z of the stages, or `least` if that is larger. Coefficients below the rounding
 * error of displacements of the size `rounded` are none. */
static real error_beyond(const step_data *step, const real *z, const stage_sizes *of, real rounded, real share,
    real decay, real least)
{
  for (int i = 0; i < M; i++) {
    const real unit = 1 / (of->size[i] + share * of->largest + REAL_MIN);
    real top = 0, next = 0, noise = 0;
    for (int b = 0; b < B; b++) {
      top += STAGE_HIGHEST[b] * z[i * B + b];
      next += STAGE_NEXT[b] * z[i * B + b];
      noise += CURVE_NOISE * MATH(fabs)(STAGE_HIGHEST[b]);
    }
    top = MATH(fabs)(top);
    top = top > VANISHING * MATH(fabs)(next) ? larger(top, decay * MATH(fabs)(next)) : top;
    noise *= larger(rounding_of_displacement(rounded), of->rounding[i]) / MATH(fabs)(step->h);
    top = top < noise ? 0 : SITES > M ? (top - noise) * unit * step->h
                                      : top * unit * step->h;
    const real allowed = 2 * unit * of->curvature[i] + NEGLIGIBLE;
    if (top * top > least * allowed)
      least = top * top / allowed;
  }
  return least;
}

/* The same of one of the curves of a step with unknowns v. Constraints hold to the rounding of positions and of their
 * own terms, however short the step is, and to that of reactions. The latter two are determined where the error exceeds
 * `doubtful` without them, `least` or more. */
static real error_of_stages(const step_data *step, const real *z, const real *v, const real *dq, real share,
    real decay, real least, real doubtful)
{
  real fastest = 0, farthest = 0, error;
  const section all = {0, M};
  stage_sizes of = {.largest = 0};
  for (int i = 0; i < M; i++) {
    const real curvature = curvature_of_stages(step, v, i);
    const real motion = motion_of_step(step, step->h, MATH(fabs)(dq[i]), curvature, i);
    of.curvature[i] = z == v ? curvature : curvature_of_stages(step, z, i);
    of.size[i] = motion;
    of.rounding[i] = rounding_of_force(step->q0[i], curvature_size(step->motion_of, step->h, curvature, i), motion);
#ifdef FEW_STAGE_COEFFICIENTS
    of.size[i] = size_for_few(step->motion_of, step->h, motion, of.curvature[i], i);
    if (starts(step, MATH(fabs)(dq[i]), of.curvature[i]))
      of.rounding[i] = INFINITY;
#endif
    fastest = larger(fastest, MATH(fabs)(dq[i]));
    farthest = larger(farthest, MATH(fabs)(step->q0[i]) + MATH(fabs)(dq[i]));
  }
  enlarge_to_absolute(step, all, of.size);
  for (int i = 0; i < M; i++)
    of.largest = larger(of.largest, of.size[i]);
  enlarge_to_arrays(of.size);
  error = error_beyond(step, z, &of, SITES > M ? farthest : fastest, share, decay, least);
  if (SITES > M && error > doubtful) {
    real lengths[M];
    lengths_of_constraints(step, lengths);
    for (int i = 0; i < M; i++)
      of.rounding[i] = larger(of.rounding[i], rounding_of_displacement(farthest + lengths[i]));
    error = error_beyond(step, z, &of, farthest, share, decay, least);
  }
  return error;
}

/* The larger error of the velocities and, where masses grow, of the momenta. */
static real stage_error(const step_data *step, const real *z, const real *dq, real share, real decay, real least,
    real doubtful)
{
#ifdef MASSES_GROW
  real grown[M * B] = {0};
  grow_velocities(step, z, B, grown);
  least = error_of_stages(step, grown, z, dq, share, 0, least, larger(least, doubtful));
#endif
  return error_of_stages(step, z, z, dq, share, decay, least, larger(least, doubtful));
}

/* The same test without the sizes: returns 0 if no coefficient exceeds `least` relative to `motion`, the size of the
 * largest coordinate or less, to which that of every coordinate is added, or the rounding error of constrained
 * positions. */
static inline int curve_of_stages_may_exceed(const step_data *step, const real *z, real motion, real decay, real least)
{
  const real unit = 1 / (motion + REAL_MIN);
  real farthest = 0;
  int exceeded = 0;
  for (int i = 0; SITES > M && i < M; i++)
    farthest = larger(farthest, MATH(fabs)(step->q0[i]));
  for (int i = 0; i < M; i++) {
    real top = 0, next = 0, noise = 0;
    for (int b = 0; b < B; b++) {
      top += STAGE_HIGHEST[b] * z[i * B + b];
      next += STAGE_NEXT[b] * z[i * B + b];
      noise += CURVE_NOISE * MATH(fabs)(STAGE_HIGHEST[b]);
    }
    top = larger(MATH(fabs)(top), decay * MATH(fabs)(next)) * MATH(fabs)(step->h);
    top = larger(top - noise * rounding_of_displacement(farthest), 0) * unit;
    exceeded |= !(top * top <= least * (2 * unit * curvature_of_stages(step, z, i) + NEGLIGIBLE));
  }
  return exceeded;
}

static inline int stages_may_exceed(const step_data *step, const real *z, real motion, real decay, real least)
{
#ifdef MASSES_GROW
  real grown[M * B] = {0};
  grow_velocities(step, z, B, grown);
  if (curve_of_stages_may_exceed(step, grown, motion, 0, least))
    return 1;
#endif
  return curve_of_stages_may_exceed(step, z, motion, decay, least);
}

/* Lets V and A contain a solved step. */
static inline void note_stages(run_memory *run, const step_data *step, const real *z, const real *dq)
{
  const real rate = 1 / MATH(fabs)(step->h);
  for (int i = 0; i < M; i++)
    note_motion(run, rate, MATH(fabs)(dq[i]), curvature_of_stages(step, z, i), i);
}
