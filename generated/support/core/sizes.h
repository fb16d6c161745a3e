#ifndef SUPPORT_SIZES_H
#define SUPPORT_SIZES_H

#include "step.h"

/* Sizes in which the errors of a step are measured. Neither depends on the origin of a coordinate, but for the rounding
 * of the coordinate itself, and both change with its unit. Per coordinate i and step h:
 *
 * Motion    mu_i = |dq_i| + |h| V_i + h^2 A_i, V_i and A_i the largest |v_i| and |a_i| of the step and, times FORMER_PART
 *           per step, of former ones: at a turning point a step has the size of those around it, and an encounter
 *           does not loosen the rest of a run.
 * Rounding  rho_i = u (|q_i| + |h v_i| + h^2 (|M^-1| F)_i + h^2 (|J| |q|)_i), F_j the sum of the absolute terms of f_j,
 *           J = da/dq, u = REAL_EPSILON / 2. In a contracting iteration h^2 |J| is at most about its rate. The increment
 *           of a step is compensated: its error is rho_i without the first term.
 *
 * The state itself enters nowhere else. Of arrays of run-time sizes V, A and mu are those of a whole array. */

#define FORMER_PART REAL(0.97) /* of the largest velocities and accelerations of former steps: 1/2 after 23 steps */

/* mu_i of the displacement by a step, and by its curvature; V and A of former steps. */
static inline real motion_size(real h, real displacement, real curvature, real v, real a)
{
  const real by_v = MATH(fabs)(h) * v, by_a = h * h * a;
  return displacement + larger(displacement, by_v) + larger(curvature, by_a);
}

/* Size mu_i^2 / (h^2 A_i), about V_i^2 / A_i, relative to which a curve of one or two coefficients shows the relative
 * error of a step: where forces vanish, these do, too, but the error of the step need not. */
static inline real size_for_few(real h, real motion, real curvature, real a)
{
  return motion * motion / (larger(curvature, h * h * a) + REAL_EPSILON * motion + REAL_MIN);
}

/* Rounding error of the displacement of coordinate i by terms of the size of the velocities of all coordinates, which
 * mass matrices couple. */
static inline real rounding_of_displacement(real largest_displacement)
{
  return REAL_EPSILON / 2 * largest_displacement;
}

#ifdef ARRAYS
enum { MOTIONS = COORDINATE_ARRAYS }; /* numbers V and A */

/* The largest displacements of the coordinates of each array in a step, and by its curvature. */
typedef struct array_motion {
  double displacement[COORDINATE_ARRAYS], curvature[COORDINATE_ARRAYS];
} array_motion;
#else
enum { MOTIONS = M };
#endif

/* What is kept of V and A when a step is added: `part`, and, of a coordinate that moves, the displacement by V in the
 * step before, 1 / `larger_by` of its size: behind an encounter steps grow faster than its velocities are forgotten. A
 * coordinate that is leaving rest has V and A of the trials for the first step. */
typedef struct {
  real part, larger_by;
} kept_motion;

#define LEAVING_REST REAL(0.03) /* relative to V and A */

/* Lets V and A of a coordinate or array contain a step. */
static inline void note_motion(run_memory *run, real h, real displacement, real curvature, kept_motion kept, int k)
{
  const real v = displacement / MATH(fabs)(h), a = curvature / (h * h);
  const int moves = v > LEAVING_REST * run->largest_v[k] || a > LEAVING_REST * run->largest_a[k];
  const real by = moves ? kept.larger_by : 1;
  run->largest_v[k] = larger(kept.part * by * run->largest_v[k], v);
  run->largest_a[k] = larger(kept.part * by * by * run->largest_a[k], a);
}

/* The largest V, and the largest mu_i of a step of h of the run so far. */
static inline real largest_velocity(const run_memory *run)
{
  real largest = 0;
  for (int k = 0; k < MOTIONS; k++)
    largest = larger(largest, run->largest_v[k]);
  return largest;
}

static inline real largest_motion(const run_memory *run, real h)
{
  real largest = 0;
  for (int k = 0; k < MOTIONS; k++)
    largest = larger(largest, motion_size(h, 0, 0, run->largest_v[k], run->largest_a[k]));
  return largest;
}

/* Size of coordinate i in which errors are measured: its motion, or the absolute one if that is larger. */
static inline real size_of_motion(const step_data *step, real motion, long long i)
{
  return step->absolute ? larger(motion, step->absolute[i]) : motion;
}

#ifdef ARRAYS
/* mu_i of a step of h, with the largest V and A of all arrays. */
static inline real motion_of_step(const step_data *step, real h, real displacement, real curvature, long long i)
{
  real v = 0, a = 0;
  for (int k = 0; k < COORDINATE_ARRAYS; k++) {
    v = larger(v, step->run->largest_v[k]);
    a = larger(a, step->run->largest_a[k]);
  }
  return size_of_motion(step, motion_size(h, displacement, curvature, v, a), i);
}
#else
/* mu_i of a step of h from its displacement and its curvature, with V and A of the run if there is one. */
static inline real motion_of_step(const step_data *step, real h, real displacement, real curvature, long long i)
{
  const int has_former = step->largest_v != NULL;
  const real motion = motion_size(h, displacement, curvature, has_former ? step->largest_v[i] : 0,
      has_former ? step->largest_a[i] : 0);
  return size_of_motion(step, motion, i);
}

/* Replaces the sizes of the elements of an array of known size by the largest of it. */
static inline void enlarge_to_arrays(real *size)
{
#ifdef ARRAYS_OF_KNOWN_SIZES
  static const int array[][2] = {ARRAYS_OF_KNOWN_SIZES};
  for (size_t k = 0; k < sizeof array / sizeof array[0]; k++) {
    real largest = 0;
    for (int i = array[k][0]; i < array[k][1]; i++)
      largest = larger(largest, size[i]);
    for (int i = array[k][0]; i < array[k][1]; i++)
      size[i] = largest;
  }
#else
  (void)size;
#endif
}
#endif

#endif
