#include "../iteration/separable_iteration.h"

/* Points of a step for Newton's method: positions, whose increments by the forces are h^2 A F / m, where A is PRODUCT;
 * with FORCES_OF_VELOCITIES also velocities, with h B F / m, where B is VELOCITY and A is B^2. */

/* Index of the rate of an unknown in F. */
#define index_of_rate(n, i) (i)

static inline double mass_of(const step_points *w, long long i)
{
  return 1.0 / w->data->inverse_mass[i];
}

/* Increment of a value of the state at the points of a group by the forces F. */
static inline lanes increment_at(const step_points *w, int part, int g, long long i, const lanes *F)
{
#ifdef FORCES_OF_VELOCITIES
  if (part == 1)
    return w->data->inverse_mass[i] * (w->step->h * contribution_of_points(VELOCITY, g, &F[i], w->n));
#endif
  return unit_of(w, i) * contribution_of_points(PRODUCT, g, &F[i], w->n);
}

static inline double start_at(const step_points *w, int part, long long i)
{
  return part == 1 ? w->data->inverse_mass[i] * w->step->p0[i] : w->step->q0[i];
}

/* Change of a value by one fixed-point iteration. */
static inline lanes residual_at(const step_points *w, int part, int g, long long i)
{
  const drift_words along = find_drift(w, i);
  const lanes sum = SUM_OF_FORCES(PRODUCT, w, g, i) + SUM_OF_FORCES(PRODUCT_LOW, w, g, i);
#ifdef FORCES_OF_VELOCITIES
  const double low = w->data->inverse_mass[i] * w->step->carry_p[i];
  if (part == 1)
    return (start_at(w, 1, i) - w->X[(2 * g + 1) * w->n + i]) + (low + increment_at(w, 1, g, i, w->F));
#endif
  return (w->step->q0[i] - w->X[g * X_VECTORS * w->n + i]) + DRIFT[g] * along.high +
      (unit_of(w, i) * sum + low_words(w, g, along, i));
}

/* Value without forces, from which the points start if that is nearer than the extrapolation: at rest, or with constant
 * velocities, so that positions and velocities are those of the same forces. */
static inline lanes unforced_at(const step_points *w, int part, int g, long long i)
{
#ifdef FORCES_OF_VELOCITIES
  if (part == 0)
    return w->step->q0[i] + DRIFT[g] * find_drift(w, i).high;
#endif
  return lanes_of(start_at(w, part, i));
}

#ifdef FORCES_OF_VELOCITIES
/* Computes the positions from the velocities, without the rounding errors of large corrections. */
static void find_positions(const step_points *w)
{
  const section own = own_part(w->step);
  for (long long i = own.first; i < own.end; i++)
    for (int g = 0; g < GROUPS; g++) {
      const lanes moved = w->step->h * contribution_of_points(VELOCITY, g, &w->X[w->n + i], 2 * w->n);
      w->X[2 * g * w->n + i] = w->step->q0[i] + (w->step->carry_q[i] + moved);
    }
}
#endif

/* Size of a value at the start of the step, with its displacement by the drift, or also by the first force. */
static inline double drifted_size(const step_points *w, int part, long long i)
{
  return fabs(start_at(w, part, i)) + (part == 0 ? fabs(find_drift(w, i).high) : 0.0);
}

static inline double first_size(const step_points *w, int part, long long i)
{
  const double size = size_of(w, find_drift(w, i), i, 1.0);
  return part == 0 ? size : size / fabs(w->step->h);
}
