#include "step.h"

/* Sizes in which the errors of a step are measured. Neither depends on the origin of a coordinate, but for the rounding
 * of the coordinate itself, and both change with its unit. Per coordinate i and step h:
 *
 * Motion    mu_i = |dq_i| + |h| V_i + h^2 A_i, V_i and A_i the largest |v_i| and |a_i| of the step and, with a
 *           forgetting factor, of former ones: at a turning point a step has the size of those around it, and an
 *           encounter does not loosen the rest of a run. The factor is one of time, not of steps: if V shrank with
 *           each step to a turning point, so would the steps, and never reach it.
 * Rounding  rho_i = u (|q_i| + |h v_i| + h^2 (|M^-1| F)_i + h^2 (|J| |q|)_i), F_j the sum of the absolute terms of f_j,
 *           J = da/dq, u = REAL_EPSILON / 2. In a contracting iteration h^2 |J| is at most about its rate. The
 *           increment of a step is compensated: its error is rho_i without the first term.
 *
 * The state itself enters nowhere else. Of arrays of run-time sizes V, A and mu are those of a whole array. */

#define LOOKED_AT 4 /* fixed steps, of which one determines sizes and is tested for an accidentally small coefficient */
#define FORGETTING REAL(0.03) /* of V and A in a tenth of the time V / A, about a tenth of a radian of a vibration */
#define TENTHS 10

/* Displacement by the curvature of a step, or of former ones: h^2 A_i, but not above the largest one of them. */
static inline real curvature_size(const run_memory *former, real h, real curvature, int k)
{
  return former ? larger(curvature, smaller(h * h * former->largest_a[k], former->largest_bend[k])) : curvature;
}

/* mu_i of the displacement by a step and by its curvature, with V and A of former steps, unless NULL. The displacement
 * by V is at most the largest of former steps: behind an encounter steps grow faster than its velocities are
 * forgotten. */
static inline real motion_size(const run_memory *former, real h, real displacement, real curvature, int k)
{
  const real by_v = former ? smaller(MATH(fabs)(h) * former->largest_v[k], former->largest_dq[k]) : 0;
  return displacement + larger(displacement, by_v) + curvature_size(former, h, curvature, k);
}

/* Size mu_i^2 / (h^2 A_i), about V_i^2 / A_i, relative to which a curve of one or two coefficients shows the relative
 * error of a step: where forces vanish, these do, too, but the error of the step need not. */
static inline real size_for_few(const run_memory *former, real h, real motion, real curvature, int k)
{
  return motion * (motion / (curvature_size(former, h, curvature, k) + REAL_EPSILON * motion + REAL_MIN));
}

/* Rounding error of the displacement of coordinate i by that of the coordinate in the forces, h^2 |J| u |q_i|: where a
 * motion is of size mu_i, h^2 |J| is about its curvature relative to it. */
static inline real rounding_of_force(real q, real curvature, real motion)
{
  return REAL_EPSILON / 2 * MATH(fabs)(q) * (curvature / (motion + REAL_MIN));
}

/* Rounding error of the displacement of coordinate i by terms of the size of the velocities of all coordinates, which
 * mass matrices couple. */
static inline real rounding_of_displacement(real largest_displacement)
{
  return REAL_EPSILON / 2 * largest_displacement;
}

#ifndef CONSTRAINED
/* Sizes of positions that round as constraints do: there are none. */
#define size_by_constraints(step) 0

#define lengths_of_constraints(step, lengths) (void)memset(lengths, 0, sizeof lengths)
#endif

#ifdef ARRAYS
enum { MOTIONS = COORDINATE_ARRAYS }; /* numbers V and A */

/* The largest displacements of the coordinates of each array in a step, and by its curvature. */
typedef struct array_motion {
  double displacement[COORDINATE_ARRAYS], curvature[COORDINATE_ARRAYS];
} array_motion;
#else
enum { MOTIONS = M };
#endif

/* Lets V and A of a coordinate or array contain a step of 1 / rate. */
static inline void note_motion(run_memory *run, real rate, real displacement, real curvature, int k)
{
  run->largest_v[k] = larger(run->largest_v[k], rate * displacement);
  run->largest_a[k] = larger(run->largest_a[k], rate * rate * curvature);
  run->largest_dq[k] = larger(run->largest_dq[k], displacement);
  run->largest_bend[k] = larger(run->largest_bend[k], curvature);
}

/* Reduces V and A by what is forgotten during a step. */
static inline void forget_motion(run_memory *run, real h)
{
  for (int k = 0; k < MOTIONS; k++) {
    const real turn = TENTHS * MATH(fabs)(h) * run->largest_a[k], v = run->largest_v[k];
#ifdef MASSES_GROW /* steps may be longer than the time in which velocities decrease */
    const real kept = v > 0 ? MATH(exp)(-FORGETTING * (turn / v)) : 1;
#else
    const real kept = 1 - FORGETTING * (turn < v ? turn / v : 1);
#endif
    run->largest_v[k] *= kept, run->largest_a[k] *= kept;
    run->largest_dq[k] *= kept, run->largest_bend[k] *= kept;
  }
}

/* Lets V and A be those of the next step alone. */
static inline void begin_motion(run_memory *run)
{
  memset(run->largest_v, 0, sizeof run->largest_v), memset(run->largest_a, 0, sizeof run->largest_a);
  memset(run->largest_dq, 0, sizeof run->largest_dq), memset(run->largest_bend, 0, sizeof run->largest_bend);
}

/* The largest mu_i of a step of h of the run so far. */
static inline real motion_of_run(const run_memory *run, real h)
{
  real largest = 0;
  for (int k = 0; k < MOTIONS; k++)
    largest = larger(largest, motion_size(run, h, 0, 0, k));
  return largest;
}

/* Enlarges the sizes of some coordinates, in which errors are measured, to the absolute ones. Not in the loops that
 * determine them: vectorised loads that a null pointer masks are slow. */
static inline void enlarge_to_absolute(const step_data *step, section here, real *size)
{
  for (long long i = here.first; step->absolute && i < here.end; i++)
    size[i - here.first] = larger(size[i - here.first], step->absolute[i]);
}

#ifndef EXPLICIT_RUN
/* Returns 1 for a motion whose velocity a pilot doubles at least, |dq_i| <= 3/2 h^2 A_i. Relative to its own motion,
 * the error of a curve of one or two coefficients is then the same at all step sizes, or falls with the first power,
 * until the pilot is so large that V_i shows the size that the motion reaches: smaller ones leave it out. */
static inline int starts(const step_data *step, real displacement, real curvature)
{
  return step->is_pilot && displacement <= REAL(1.5) * curvature;
}
#endif

#ifdef ARRAYS
/* mu_i of a step of h, with the largest V and A of all arrays. */
static inline real motion_of_step(const step_data *step, real h, real displacement, real curvature, long long i)
{
  real motion = 0;
  for (int k = 0; k < COORDINATE_ARRAYS; k++)
    motion = larger(motion, motion_size(step->run, h, displacement, curvature, k));
  return motion;
}
#else
/* mu_i of a step of h from its displacement and its curvature, with V and A of the run if there is one. */
static inline real motion_of_step(const step_data *step, real h, real displacement, real curvature, long long i)
{
  return motion_size(step->motion_of, h, displacement, curvature, (int)i);
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
#endif
}
#endif
