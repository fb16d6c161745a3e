#include "../core/progress.h"
#include "../iteration/one_trajectory.h"
#include "../iteration/point_weights.h"
#include "arrays.h"

/* Points of a step of an array Hamiltonian system, with the equations of hamiltonian_iteration.h, and their fixed-point
 * iteration. Since one function computes all rates from terms that contain positions and momenta, both are updated
 * together (Jacobi), not in turn. Requires: the tables, forces_at, which computes the rates at the points: -H_q of the
 * momenta, then H_p of the positions. Momenta follow positions in memory. */

#define SUDDEN_GROWTH 1e20 /* of the largest coordinate in one iteration: a larger one changes the whole state */
#define KEPT_FIRST(apart) ((apart) / 2) /* velocities follow forces */

/* Positions or momenta: the state and the points; their rates, a table and weights; the largest size so
 * far, also of each array. */
typedef struct {
  const double *start, *carry;
  lanes *y;
  const lanes *rates, *table, *end, *weights;
  double largest, of_array[COORDINATE_ARRAYS];
} half_state;

/* Rates of coordinate i at the points times the weights. */
static inline void weighted_rates(const half_state *of, long long apart, long long i, lanes *scaled)
{
  for (int g = 0; g < GROUPS; g++)
    scaled[g] = of->weights[g] * of->rates[g * apart + i];
}

/* Arguments and arrays of a step: the points X, their rates F, and both halves of the state. */
typedef struct {
  const step_data *step;
  const iteration_data *data;
  lanes *X, *F;
  long long n;
  half_state half[2];
} step_points;

static step_points points_in(const step_data *step, const iteration_data *data, history past)
{
  const long long n = step->n;
  lanes *X = step->work->X;
  const half_state q = {step->q0, step->carry_q, X, past.now + n, POSITION, POINT_END_POSITION,
      data->position_weight, 0.0, {0.0}};
  const half_state p = {step->p0, step->carry_p, X + n, past.now, MOMENTUM, POINT_END_MOMENTUM,
      data->momentum_weight, 0.0, {0.0}};
  return (step_points){step, data, X, past.now, n, {q, p}};
}

static void forces(const step_points *w)
{
  forces_at(w->step, w->X, 2 * w->n, w->F);
}

/* Extrapolates the rates from former steps, if any. */
static void first_rates(const step_points *w, history past, long long steps)
{
  const section own = own_part(w->step);
  for (int g = 0; g < GROUPS; g++)
    for (long long half = 0; half < 2 * w->n; half += w->n)
      for (long long i = half + own.first; i < half + own.end; i++)
        w->F[g * 2 * w->n + i] = extrapolated(w->step, past, steps, g, i);
}

#ifndef NEWTON_KRYLOV
/* Updates y from its rates; returns the mean of the squared changes relative to the size of each coordinate. */
static double improve(const step_data *step, half_state *of, const solver_options *options)
{
  const double before = of->largest;
  coordinate_array array[COORDINATE_ARRAYS];
  double change;
  sums all;
  describe_coordinate_arrays(step->arrays, array);
  EACH_BLOCK (all, step) {
    lanes total = lanes_of(0.0), increment[GROUPS], scaled[GROUPS];
    double values[1 + COORDINATE_ARRAYS] = {0.0};
    for (int k = 0; k < COORDINATE_ARRAYS; k++) {
      const section part = part_in(all.here, &array[k]);
      const double least = least_size(&array[k], of->of_array[k], before);
      for (long long i = part.first; i < part.end; i++) {
        double size, inverse;
        weighted_rates(of, 2 * step->n, i, scaled);
        for (int g = 0; g < GROUPS; g++)
          increment[g] = contribution_of_points(of->table, g, scaled, 1);
        size = fabs(of->start[i]) + fabs(at_point(increment, 1, POINTS - 1));
        inverse = options->absolute ? 1.0 : 1.0 / (size + least);
        values[1 + k] = larger(values[1 + k], size);
        for (int g = 0; g < GROUPS; g++) {
          lanes *y = &of->y[g * 2 * step->n + i];
          const lanes x = of->start[i] + (of->carry[i] + increment[g]), moved = inverse * (x - *y);
          total += moved * moved;
          *y = x;
        }
      }
    }
    values[0] = lanes_total(total);
    add_values(&all, values, 1 + COORDINATE_ARRAYS);
  }
  meet(step);
  change = sum_of(&all, 0) / (options->absolute ? 1.0 : (double)step->n);
  of->largest = 0.0;
  for (int k = 0; k < COORDINATE_ARRAYS; k++) {
    of->of_array[k] = largest_over(&all, 1 + k);
    of->largest = larger(of->largest, of->of_array[k]);
  }
  return of->largest > SUDDEN_GROWTH * before ? 1.0 : change;
}

#endif

/* Computes the increments of positions, whose low words are 0, and of momenta at the end of the step. */
static void find_increments(const step_points *w, section own, double *dq, double *dp)
{
  for (long long i = own.first; i < own.end; i++) {
    lanes scaled[GROUPS];
    weighted_rates(&w->half[0], 2 * w->n, i, scaled);
    dq[i] = weigh_apart(w->half[0].end, scaled, 1), dq[w->n + i] = 0.0;
    weighted_rates(&w->half[1], 2 * w->n, i, scaled);
    dp[i] = weigh_apart(w->half[1].end, scaled, 1);
  }
}

#ifdef NEWTON_KRYLOV
/* For Newton's method: the state consists of positions, then momenta, whose increments by the rates are h A F. */

/* Index of the rate of an unknown in F. */
static inline long long index_of_rate(long long n, long long i)
{
  return i < n ? i + n : i - n;
}

#define mass_of(w, i) 1.0

#define unit_of(w, i) (w)->step->h

/* Increment of a value of the state at the points of a group by the rates F. */
static inline lanes increment_at(const step_points *w, int part, int g, long long i, const lanes *F)
{
  half_state of = w->half[part];
  lanes scaled[GROUPS];
  of.rates = F + index_of_rate(w->n, part * w->n);
  weighted_rates(&of, 2 * w->n, i, scaled);
  return contribution_of_points(of.table, g, scaled, 1);
}

static inline double start_at(const step_points *w, int part, long long i)
{
  return w->half[part].start[i];
}

/* Change of a value by one fixed-point iteration. */
static inline lanes residual_at(const step_points *w, int part, int g, long long i)
{
  const lanes increment = w->half[part].carry[i] + increment_at(w, part, g, i, w->F);
  return (start_at(w, part, i) - w->X[(2 * g + part) * w->n + i]) + increment;
}

/* Value without rates. */
static inline lanes unforced_at(const step_points *w, int part, int g, long long i)
{
  return lanes_of(start_at(w, part, i));
}

/* Size of a value at the start of the step, and with its first increment. */
static inline double drifted_size(const step_points *w, int part, long long i)
{
  return fabs(start_at(w, part, i));
}

static inline double first_size(const step_points *w, int part, long long i)
{
  lanes increment = increment_at(w, part, GROUPS - 1, i, w->F);
  return drifted_size(w, part, i) + fabs(at_point(&increment, 1, LANES - 1));
}

/* Points with the extrapolated rates, or at rest. */
static void first_points(const step_points *w, history past, long long steps)
{
  const section own = own_part(w->step);
  first_rates(w, past, steps);
  for (int part = 0; part < 2; part++)
    for (int g = 0; g < GROUPS; g++)
      for (long long i = own.first; i < own.end; i++)
        w->X[(2 * g + part) * w->n + i] =
            start_at(w, part, i) + (w->half[part].carry[i] + increment_at(w, part, g, i, w->F));
  meet(w->step); /* before the rates are overwritten */
}
#else

/* Computes the increments of one step: iterates until the points converge. Errors of positions become errors of momenta
 * in one iteration and back in the next, so that changes are judged in pairs. Starts from the rates of *steps former
 * steps; on success *steps is the number of steps for the next predictor. */
static int fixed_point(const step_data *step, const iteration_data *data, history past, long long *steps, double *dq,
    double *dp, const solver_options *options, solver_report *report)
{
  step_points w = points_in(step, data, past);
  progress now = before_iterations();
  double last = 0.0;
  first_rates(&w, past, *steps);
  for (int k = 0; needs_iteration(&now); k++) {
    const double of_q = improve(step, &w.half[0], options), both = of_q + improve(step, &w.half[1], options);
    forces(&w);
    if (k > 0 && k % 2 == 0)
      take_change(&now, last + both, options, k / 2 - 1, report);
    last = both;
  }
  TRY(outcome(&now, report));
  find_increments(&w, own_part(step), dq, dp);
  TRY(accept(step, dq, dp));
  *steps = next_guess(*steps, &now, report);
  return OK;
}
#endif
