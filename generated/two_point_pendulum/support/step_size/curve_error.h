#ifndef SUPPORT_CURVE_ERROR_H
#define SUPPORT_CURVE_ERROR_H

#include "../core/step.h"
#include "../iteration/convergence.h"

/* Error estimate of a step from the leading coefficient of its curve. Requires: points.h, step.h, the tables HIGHEST
 * and NEXT; RESOLVED and NEXT_RESOLVED, which convert to coefficients of the acceleration; KEPT, the number of
 * stored values per coordinate, KEPT_VELOCITIES, 1 if they are velocities, and KEPT_UNIT(i), the displacement of
 * coordinate i per unit of them. */

enum { CHUNK = M };

typedef const double *stored_values;

#define STORED(run, step) ((run)->memory)

static inline double stored_at(stored_values of, long long i, int point)
{
  return of[i * POINTS + point];
}

static inline double coefficient(const lanes *table, stored_values of, long long i)
{
  lanes all[GROUPS];
  memcpy(all, of + i * POINTS, sizeof all);
  return weigh_apart(table, all, 1);
}

/* Size of a coordinate: at the start, and its increment. */
static inline double moved_size(const step_data *step, const double *dq, long long i)
{
  return fabs(step->q0[i]) + fabs(dq[i]);
}

/* Largest, over at most CHUNK coordinates, of (displacement due to the leading coefficient)^2 / (displacement due to
 * the curvature of the curve), all relative to the size of the coordinate, or `least` if that is larger, as it is
 * after most steps. A leading coefficient below `decay` times the next lower one is replaced by that product: of two
 * neighbours at most one is near a sign change (0: no test). `share` of the largest coordinate is added to each
 * size: EACH if each coordinate is to be accurate by itself, ALL if the state is. One loop per kind of arithmetic,
 * so that they vectorise. */
static inline double unresolved_part(const step_data *step, const iteration_data *data, stored_values of, section here,
    const double *size, double largest, double share, double decay, double least)
{
  const double unit = scale_of(largest), added = share * largest + DBL_MIN;
  double top[CHUNK], curvature[CHUNK], relative[CHUNK];
  const long long first = here.first, count = here.end - here.first;
  int exceeded = 0;
  for (long long k = 0; k < count; k++) {
    const double start = stored_at(of, first + k, 0), end = stored_at(of, first + k, KEPT - 1);
    curvature[k] = KEPT_VELOCITIES ? fabs(end - start) + fabs(stored_at(of, first + k, KEPT / 2) - start)
                                   : fabs(start) + fabs(end);
  }
  for (long long k = 0; k < count; k++)
    top[k] = fabs(RESOLVED * coefficient(HIGHEST, of, first + k));
  for (long long k = 0; decay > 0.0 && k < count; k++)
    top[k] = larger(top[k], decay * fabs(NEXT_RESOLVED * coefficient(NEXT, of, first + k)));
  for (long long k = 0; k < count; k++) {
    const double moved = unit * KEPT_UNIT(first + k);
    relative[k] = unit * (size[k] + added);
    top[k] *= moved;
    top[k] *= top[k];
    curvature[k] = (fabs(moved) * curvature[k] + NEGLIGIBLE * relative[k]) * relative[k];
    exceeded |= top[k] > least * curvature[k];
  }
  for (long long k = 0; exceeded && k < count; k++)
    if (top[k] > least * curvature[k])
      least = top[k] / curvature[k];
  (void)step, (void)data;
  return least;
}

/* Maximum of unresolved_part over all coordinates. */
static inline double curve_error(const step_data *step, const iteration_data *data, stored_values of, const double *dq,
    double share, double decay, double least)
{
  const section all = {0, M};
  double size[M];
  for (int i = 0; i < M; i++)
    size[i] = moved_size(step, dq, i);
  return unresolved_part(step, data, of, all, size, largest_number(size), share, decay, least);
}

#define LOOKED_AT 4 /* fixed steps, of which one is tested for an accidentally small coefficient */

/* The decay for runs that report the largest error of many steps, few of which are small by accident. */
static inline double now_and_then(const run_memory *run)
{
  return run->step % LOOKED_AT == 0 ? DECAY : 0.0;
}

#endif
