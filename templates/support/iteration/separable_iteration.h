#include "../core/vectors.h"

/* Fixed-point iteration of a step for constant diagonal masses and forces F(q, t) (Li, Wu & Leok, eqs. (25)-(30)): X_n
 * = q0 + h c_n v0 + h^2 sum_j (a A)_nj F(X_j) / m, with the quadrature points or the trajectories as SIMD lanes.
 * Coefficients are double-double: the sum of a table and its _LOW partner. Values at the points are in flat arrays,
 * [group of points][coordinate], whose groups are EXTENT(n) elements apart: M coordinates or, if ARRAYS is defined, n,
 * which is known at run time. Requires: points.h or trajectories.h with what they require, the tables, the kernels
 * force_lanes and mass; with ARRAYS forces_at, and FORCES_OF_VELOCITIES if forces depend on velocities, too. */

#ifdef ARRAYS
#define EXTENT(n) (n)
#define PASS static inline
#else
#define EXTENT(n) M
#define PASS static inline __attribute__((always_inline))
#endif

#ifdef FORCES_OF_VELOCITIES
#define VELOCITIES 1
#else
#define VELOCITIES 0
#endif

#include "remainder.h"

enum { OF_EACH = 1 + VELOCITIES }; /* values per coordinate in X: positions, then velocities */

#ifdef LINEAR_FORCES
#include "linear_part.h"
#endif

#if defined(LINEAR_FORCES) && defined(POINTS)
#define POOR_GUESS 4.0 /* predictions with errors above twice the state (squared) */
#define STRAIGHT 24 /* steps that begin with a straight line after one */
#define BEGINS_STRAIGHT(steps) ((steps) == 0 || (steps) > 2)

/* Number of former steps for the next predictor, or 2 + the number of steps that begin with a straight line: fast
 * vibrations turn by several radians in a step, so that their extrapolation may be worse. */
static long long next_of_vibrations(long long steps, double first_change)
{
  if (steps > 2)
    return steps > 3 ? steps - 1 : 1;
  return steps > 0 && first_change > POOR_GUESS ? 2 + STRAIGHT : steps_to_continue(steps, first_change);
}
#else
#define BEGINS_STRAIGHT(steps) ((steps) == 0)
#endif

#if defined(ADAPTIVE_STEPS) && !defined(MIXED_POINTS)
#define ROUGH 1e-12 /* tolerance of the iteration above which low words have no effect on an adaptive step */
#endif

#define FEW 8 /* coordinates, whose squared changes are added, which is faster */

/* Constants of a step size: h^2 = square + square_low, h w = kick + kick_low. */
typedef struct {
  weight kick[GROUPS], kick_low[GROUPS];
#ifdef ARRAYS
  const number *inverse_mass;
#else
  number inverse_mass[M];
#endif
  real square, square_low;
#ifdef LINEAR_FORCES
  linear_part linear;
#endif
} iteration_data;

/* h v of a coordinate. */
typedef struct {
  number high, low;
} drift_words;

/* Arguments and arrays of a step: the points X and the forces F there; those before the last iteration and the weights
 * of their change in the increments, or NULL without a remainder. */
typedef struct {
  const step_data *step;
  const iteration_data *data;
  lanes *X, *F;
  long long n;
  number *inverse_size;
  lanes *former;
  remainder_weights *remainder;
#ifdef ARRAYS
  double *earlier; /* last points of an earlier iterate, then the forces there */
#else
  lanes *earlier; /* an earlier iterate, whose forces are in `former` */
  drift_words *drifts;
  lanes *base; /* points of the straight line */
#endif
} step_points;

static void prepare_step_size(real h, iteration_data *data)
{
  data->square = h * h;
  data->square_low = rest_of_product(h, h, data->square);
  for (int n = 0; n < GROUPS; n++) {
    data->kick[n] = h * POINT_END_MOMENTUM[n];
    data->kick_low[n] = rest_of_weights(h, POINT_END_MOMENTUM[n], data->kick[n]) + h * POINT_END_MOMENTUM_LOW[n];
  }
}

PASS drift_words find_drift(const step_points *w, long long i)
{
  const real h = w->step->h;
  const number inverse = w->data->inverse_mass[i], v = inverse * w->step->p0[i];
  const number v_low = rest_of_numbers(inverse, w->step->p0[i], v);
  drift_words of;
  of.high = h * v;
  of.low = rest_of_numbers(number_of(h), v, of.high) + h * (v_low + inverse * w->step->carry_p[i]);
  return of;
}

/* The drift of a coordinate and its points without forces. Those of few coordinates are stored, those of many are
 * computed again. */
#ifdef ARRAYS
#define DRIFT_OF(w, i) find_drift(w, i)
#define STRAIGHT_LINE(w, g, i, of) ((w)->step->q0[i] + DRIFT[g] * (of).high)
#else
#define DRIFT_OF(w, i) ((w)->drifts[i])
#define STRAIGHT_LINE(w, g, i, of) ((void)(of), (w)->base[(g) * M + (i)])
#endif

/* sum_j table_gj F_j of a coordinate. */
#define SUM_OF_FORCES(table, w, g, i) contribution_of_points(table, g, &(w)->F[i], EXTENT((w)->n))

/* h^2 / m. */
PASS number unit_of(const step_points *w, long long i)
{
  return w->data->square * w->data->inverse_mass[i];
}

/* Size of a coordinate in the step: its motion |h v| + |h^2 F / m| and `part` of |q| (part_of_position). */
PASS number size_of(const step_points *w, drift_words of, long long i, real part)
{
  return part * magnitude(w->step->q0[i]) + magnitude(of.high) + magnitude(unit_of(w, i) * at_first(&w->F[i]));
}

/* Low words of a point without forces. */
PASS lanes low_words(const step_points *w, int g, drift_words of, long long i)
{
  return w->step->carry_q[i] + DRIFT[g] * of.low + DRIFT_LOW[g] * of.high;
}

/* x + (y + rest), where rest is below the rounding error of x + y, by a two-sum. */
static inline lanes sum_of_three(lanes x, lanes y, lanes rest)
{
  const lanes sum = x + y, part = sum - x;
  return sum + (((x - (sum - part)) + (y - part)) + rest);
}

/* Displacement of a point from q0 with double-double coefficients, and low words with those of q0. */
PASS lanes displacement_of(const step_points *w, int g, long long i, lanes *low)
{
  const iteration_data *data = w->data;
  const drift_words of = DRIFT_OF(w, i);
  const lanes sum = SUM_OF_FORCES(PRODUCT, w, g, i), rest = SUM_OF_FORCES(PRODUCT_LOW, w, g, i);
  *low = low_words(w, g, of, i) + data->inverse_mass[i] * (data->square * rest) +
      data->inverse_mass[i] * (data->square_low * sum);
  return DRIFT[g] * of.high + data->inverse_mass[i] * (data->square * sum);
}

/* Increments of a coordinate: of q, with its low word, and of p. */
typedef struct {
  number q, q_low, p;
} end_increments;

/* sum_n weights_n F_n of a coordinate, with the remainder of the iteration. */
PASS number weigh_forces(const step_points *w, const weight *weights, const weight *low, const lanes *further,
    long long i)
{
  if (!w->former)
    return weigh_apart_twice(weights, low, &w->F[i], EXTENT(w->n));
  return weigh_apart_thrice(weights, low, &w->F[i], further, &w->former[i], EXTENT(w->n));
}

PASS end_increments increments_of(const step_points *w, long long i)
{
  const iteration_data *data = w->data;
  const drift_words of = DRIFT_OF(w, i);
  const lanes *position = w->former ? w->remainder->position : NULL;
  const lanes *momentum = w->former ? w->remainder->momentum : NULL;
  const number sum = weigh_forces(w, POINT_END_POSITION, POINT_END_POSITION_LOW, position, i);
  const number kick = data->inverse_mass[i] * (data->square * sum), q = of.high + kick, part = q - of.high;
  end_increments end;
  end.q = q;
  end.q_low = (of.high - (q - part)) + (kick - part) + (of.low + data->inverse_mass[i] * (data->square_low * sum));
  end.p = weigh_forces(w, data->kick, data->kick_low, momentum, i);
  return end;
}

/* Adds the square of a change. For many coordinates with names the sum of the rounding errors would stay above the
 * tolerance: there it is the largest. A NaN is detected later, by the increments. */
static inline lanes with_change(lanes change, lanes moved, real share)
{
#ifndef ARRAYS
  if (M > FEW)
    return larger_lanes(change, moved * moved);
#endif
  return change + share * (moved * moved);
}

/* Updates the points of a range of coordinates from the forces; returns the sum of the squared relative changes. */
PASS lanes improve_points(const step_points *w, section here)
{
  lanes change = lanes_of(0.0);
  for (long long i = here.first; i < here.end; i++) {
    const drift_words of = DRIFT_OF(w, i);
    const number unit = unit_of(w, i);
    for (int g = 0; g < GROUPS; g++) {
      lanes *X = &w->X[g * OF_EACH * EXTENT(w->n) + i];
      const lanes curved = unit * SUM_OF_FORCES(PRODUCT, w, g, i);
      const lanes x = STRAIGHT_LINE(w, g, i, of) + curved;
      change = with_change(change, (x - *X) * w->inverse_size[i], CHANGES_OF(g));
      *X = x;
    }
  }
  return change;
}

/* Computes the points of a range of coordinates with double-double coefficients, which the iterations before lack, and
 * stores their former forces. Rounding of the coefficients displaces the points to the same side in every step; the
 * remainder extends the correction of the last iteration to a whole one. */
PASS void refine_points(const step_points *w, section here)
{
  for (long long i = here.first; i < here.end; i++)
    for (int g = 0; g < GROUPS; g++) {
      lanes low, moved = displacement_of(w, g, i, &low);
      w->X[g * OF_EACH * EXTENT(w->n) + i] = sum_of_three(lanes_of_number(w->step->q0[i]), moved, low);
      if (w->former)
        w->former[g * EXTENT(w->n) + i] = w->F[g * EXTENT(w->n) + i];
    }
}

#ifdef ROUGH
/* Increments without low words of the weights. */
PASS void find_rough_increments(const step_points *w, number *dq, number *dp)
{
  for (int i = 0; i < M; i++) {
    const drift_words of = DRIFT_OF(w, i);
    const number kick = unit_of(w, i) * weigh_apart(POINT_END_POSITION, &w->F[i], M);
    dq[i] = of.high + kick, dq[M + i] = (of.high - dq[i]) + kick;
    dp[i] = weigh_apart(w->data->kick, &w->F[i], M);
  }
}
#else
#define find_rough_increments(w, dq, dp) (void)0
#endif

#if defined(SUMS_OF_EIGHT) && defined(EIGHT_COORDINATES)
/* increments_of eight coordinates, which are lanes; dq_low: low words. */
PASS void find_eight_increments(const step_points *w, int i, double *dq, double *dq_low, double *dp)
{
  const iteration_data *data = w->data;
  lanes position[8], momentum[8];
  lane_view high, low, inverse;
  for (int k = 0; k < 8; k++) {
    const lanes F = w->F[i + k];
    const drift_words of = DRIFT_OF(w, i + k);
    const lanes moved = w->former ? F - w->former[i + k] : lanes_of(0.0);
    position[k] = multiply_add(
        POINT_END_POSITION[0], F, multiply_add(w->remainder->position[0], moved, POINT_END_POSITION_LOW[0] * F));
    momentum[k] = multiply_add(
        data->kick[0], F, multiply_add(w->remainder->momentum[0], moved, data->kick_low[0] * F));
    high.lane[k] = of.high, low.lane[k] = of.low, inverse.lane[k] = data->inverse_mass[i + k];
  }
  const lanes sum = totals_of_eight(position), kick = inverse.all * (data->square * sum);
  const lanes q = high.all + kick, part = q - high.all, p = totals_of_eight(momentum);
  const lanes q_low = (high.all - (q - part)) + (kick - part) + (low.all + inverse.all * (data->square_low * sum));
  memcpy(dq + i, &q, sizeof q);
  memcpy(dq_low + i, &q_low, sizeof q_low);
  memcpy(dp + i, &p, sizeof p);
}
#endif

/* Computes the increments of a range of coordinates; low words follow those of q. */
PASS void find_increments(const step_points *w, section here, number *dq, number *dp)
{
#if defined(SUMS_OF_EIGHT) && defined(EIGHT_COORDINATES)
  enum { IN_EIGHTS = GROUPS == 1 ? M / 8 * 8 : 0 };
  for (int i = 0; i < IN_EIGHTS; i += 8)
    find_eight_increments(w, i, dq, dq + M, dp);
  here.first = IN_EIGHTS;
#endif
  for (long long i = here.first; i < here.end; i++) {
    const end_increments end = increments_of(w, i);
    dq[i] = end.q, dq[EXTENT(w->n) + i] = end.q_low, dp[i] = end.p;
  }
}

#ifdef ARRAYS
#define KEPT_FIRST(apart) 0

static void prepare_iteration(const step_data *step, iteration_data *data)
{
  prepare_step_size(step->h, data);
  data->inverse_mass = step->run->inverse_mass;
}

static step_points points_in(const step_data *step, const iteration_data *data, history past)
{
  return (step_points){step, data, step->work->X, past.now, step->n, step->work->inverse_size, NULL, NULL, NULL};
}

static void forces(const step_points *w)
{
  forces_at(w->step, w->X, OF_EACH * w->n, w->F);
}

#ifdef FORCES_OF_VELOCITIES
/* Updates the velocities at the points from the forces; returns the sum of the squared relative changes times h. */
static lanes improve_velocities(const step_points *w, section here)
{
  const step_data *step = w->step;
  lanes change = lanes_of(0.0);
  for (int g = 0; g < GROUPS; g++) {
    lanes *V = w->X + (g * OF_EACH + 1) * w->n;
    for (long long i = here.first; i < here.end; i++) {
      const lanes kick = step->carry_p[i] + step->h * SUM_OF_FORCES(VELOCITY, w, g, i);
      const lanes v = w->data->inverse_mass[i] * (step->p0[i] + kick);
      change = with_change(change, step->h * (v - V[i]) * w->inverse_size[i], CHANGES_OF(g));
      V[i] = v;
    }
  }
  return change;
}
#else
#define improve_velocities(w, here) lanes_of(0.0)
#endif

/* Points of the straight line or, if there are former steps, with extrapolated forces. */
static void first_points(const step_points *w, history past, long long steps)
{
  const section own = own_part(w->step);
  for (long long i = own.first; i < own.end; i++) {
    const drift_words of = find_drift(w, i);
    for (int g = 0; g < GROUPS; g++) {
      const lanes force = extrapolated(w->step, past, steps, g, i);
      if (VELOCITIES) /* the extrapolation is of forces, from which velocities follow, too */
        w->F[g * w->n + i] = force;
      w->X[g * OF_EACH * w->n + i] = STRAIGHT_LINE(w, g, i, of);
      if (!VELOCITIES && steps > 0)
        w->X[g * OF_EACH * w->n + i] += unit_of(w, i) * force;
    }
    for (int g = 0; VELOCITIES && g < GROUPS; g++)
      w->X[g * OF_EACH * w->n + i] += unit_of(w, i) * SUM_OF_FORCES(PRODUCT, w, g, i);
  }
  improve_velocities(w, own);
}

/* Sizes of the coordinates. */
static inline void measure_points(const step_points *w, const solver_options *options)
{
  coordinate_array array[COORDINATE_ARRAYS];
  const double resolved = part_of_position(options);
  double largest = 0.0;
  sums all;
  describe_coordinate_arrays(w->step->arrays, array);
  EACH_BLOCK (all, w->step) {
    double values[COORDINATE_ARRAYS] = {0.0};
    for (int k = 0; k < COORDINATE_ARRAYS; k++) {
      const section part = part_in(all.here, &array[k]);
      for (long long i = part.first; i < part.end; i++) {
        w->inverse_size[i] = size_of(w, find_drift(w, i), i, resolved);
        values[k] = larger(values[k], w->inverse_size[i]);
      }
    }
    add_values(&all, values, COORDINATE_ARRAYS);
  }
  meet(w->step);
  for (int k = 0; k < COORDINATE_ARRAYS; k++)
    largest = larger(largest, largest_over(&all, k));
  for (int k = 0; k < COORDINATE_ARRAYS; k++) {
    const double least = least_size(&array[k], largest_over(&all, k), largest);
    invert_sizes(options, largest, least, w->n, part_in(own_part(w->step), &array[k]), w->inverse_size);
  }
}

/* Stores the present iterate: of the points the last one, as derivatives of forces act at each point alone. */
static inline void keep_iterate(const step_points *w)
{
  const section own = own_part(w->step);
  for (long long i = own.first; i < own.end; i++) {
    w->earlier[i] = at_point(&w->X[i], OF_EACH * w->n, KEPT - 1);
    w->earlier[w->n + i] = at_point(&w->F[i], w->n, KEPT - 1);
  }
}

/* Rayleigh quotient of the changes since then. */
static inline double measure_stiffness(const step_points *w)
{
  sums all;
  EACH_BLOCK (all, w->step) {
    double work = 0.0, size = 0.0;
    for (long long i = all.here.first; i < all.here.end; i++) {
      const double moved = at_point(&w->X[i], OF_EACH * w->n, KEPT - 1) - w->earlier[i];
      const double weighted = moved * w->inverse_size[i] * w->inverse_size[i];
      work += weighted * unit_of(w, i) * (at_point(&w->F[i], w->n, KEPT - 1) - w->earlier[w->n + i]);
      size += weighted * moved;
    }
    add_block(&all, work, size);
  }
  meet(w->step);
  return find_stiffness(sum_of(&all, 0), sum_of(&all, 1));
}

static inline double improve(const step_points *w)
{
  sums all;
  EACH_BLOCK (all, w->step) {
    const lanes change = improve_points(w, all.here);
    add_block(&all, lanes_total(change + improve_velocities(w, all.here)), 0.0);
  }
  meet(w->step);
  return sum_of(&all, 0);
}
#else
static void prepare_iteration(const step_data *step, iteration_data *data)
{
  prepare_step_size(step->h, data);
  mass(NULL, step->t, step->parameters, data->inverse_mass);
  for (int i = 0; i < M; i++)
    data->inverse_mass[i] = 1.0 / data->inverse_mass[i];
#ifdef LINEAR_FORCES
  factorise_linear_part(step->parameters, data->square, data->inverse_mass, &data->linear);
#endif
}

PASS void forces(const step_points *w)
{
  for (int g = 0; g < GROUPS; g++)
    force_lanes(w->X + g * M, w->step->t + w->step->h * ABSCISSA[g], w->step->parameters, w->F + g * M);
}

/* Points of the straight line or, if there are former steps, with extrapolated forces. */
PASS void first_points(const step_points *w, history past, long long steps)
{
  for (int i = 0; i < M; i++) {
    w->drifts[i] = find_drift(w, i);
    for (int g = 0; g < GROUPS; g++)
      w->X[g * M + i] = w->base[g * M + i] = w->step->q0[i] + DRIFT[g] * w->drifts[i].high;
  }
  if (BEGINS_STRAIGHT(steps))
    return;
  continue_curve(w->step, past, steps, (coordinates *)w->F);
  for (int i = 0; i < M; i++)
    for (int g = 0; g < GROUPS; g++)
      w->X[g * M + i] += unit_of(w, i) * w->F[g * M + i];
}

/* Sizes of the coordinates. */
PASS void measure_points(const step_points *w, const solver_options *options)
{
  const real resolved = part_of_position(options);
  for (int i = 0; i < M; i++)
    w->inverse_size[i] = size_of(w, w->drifts[i], i, resolved);
  invert_sizes(options, 1.0, w->inverse_size);
}

/* Stores the present iterate. */
PASS void keep_iterate(const step_points *w)
{
  memcpy(w->earlier, w->X, sizeof(coordinates) * GROUPS);
  memcpy(w->former, w->F, sizeof(coordinates) * GROUPS);
}

/* Rayleigh quotient of the changes since then. */
PASS number measure_stiffness(const step_points *w)
{
  lanes work = lanes_of(0.0), size = lanes_of(0.0);
  for (int i = 0; i < M; i++) {
    const number unit = unit_of(w, i), inverse_square = w->inverse_size[i] * w->inverse_size[i];
    for (int g = 0; g < GROUPS; g++) {
      const lanes moved = w->X[g * M + i] - w->earlier[g * M + i], weighted = inverse_square * moved;
      work += weighted * (unit * (w->F[g * M + i] - w->former[g * M + i]));
      size += weighted * moved;
    }
  }
  return find_stiffness(total_change(work), total_change(size));
}

PASS number improve(const step_points *w)
{
  const section all = {0, M};
  return total_change(improve_points(w, all));
}
#endif

#ifdef LINEAR_FORCES
#define solves_linear_part(data) ((data)->linear.is_used)

/* Corrects the points by solving for the linear part of the forces; returns the largest squared relative change. */
static number correct_points(const step_points *w)
{
  coordinates d[GROUPS];
  lanes change = lanes_of(0.0);
  for (int i = 0; i < M; i++)
    for (int g = 0; g < GROUPS; g++) {
      d[g][i] = (w->base[g * M + i] - w->X[g * M + i]) + unit_of(w, i) * SUM_OF_FORCES(PRODUCT, w, g, i);
    }
  solve_linear_part(&w->data->linear, d[0]);
  for (int i = 0; i < M; i++)
    for (int g = 0; g < GROUPS; g++) {
      change = with_change(change, d[g][i] * w->inverse_size[i], CHANGES_OF(g));
      w->X[g * M + i] += d[g][i];
    }
  return total_change(change);
}

/* Corrects the points and, by their linear part, the forces, with double-double coefficients. */
static void refine_forces(const step_points *w)
{
  const linear_part *linear = &w->data->linear;
  coordinates d[GROUPS];
  for (int i = 0; i < M; i++)
    for (int g = 0; g < GROUPS; g++) {
      lanes low, moved = displacement_of(w, g, i, &low);
      d[g][i] = (w->step->q0[i] - w->X[g * M + i]) + moved + low;
    }
  solve_linear_part(linear, d[0]);
  for (int g = 0; g < GROUPS; g++)
    for (int i = 0; i < M; i++)
      w->X[g * M + i] += d[g][i];
  correct_forces(linear, d[0], w->F);
}
#else
#define solves_linear_part(data) 0
#define correct_points(w) number_of(0.0)
#define refine_forces(w) (void)0
#endif

#ifndef NEWTON_KRYLOV
/* Computes the increments of one step and their low words. The points X are iterated until they converge, then, unless
 * `rough`, once more with double-double coefficients; the forces are stored for the predictor. implicit: 1 if equations
 * are solved for the linear part of the forces; rough: 1 without low words. On failure the increments are undefined. */
HOT int iterate(const step_data *step, const iteration_data *data, history past, long long *steps, number *dq,
    number *dp, const solver_options *options, solver_report *report, int implicit, int rough)
{
#ifdef ARRAYS
  const section own = own_part(step);
  step_points w = points_in(step, data, past);
  w.former = VELOCITIES || implicit ? NULL : past.before;
  w.earlier = dq;
#else
  const section own = {0, M};
  coordinates X[GROUPS], base[GROUPS], former[GROUPS], earlier[GROUPS];
  coordinates local[GROUPS], *F = kept(past, local);
  drift_words drifts[M];
  number inverse_size[M];
  step_points w = {step, data, X[0], F[0], M, inverse_size, implicit || rough ? NULL : former[0], NULL, earlier[0],
      drifts, base[0]};
#ifndef POINTS
  coordinates stored[S];
#endif
#endif
#ifdef HEAT_BATH
  w.former = NULL; /* a remainder prevents drifts of the energy, which a bath exchanges */
#endif
  remainder_weights remainder;
  number stiffness = number_of(0.0);
  progress now = before_iterations();
  int measures;
  w.remainder = &remainder;
#ifdef ROUGH
  now.unmeasured = !rough; /* rates of loose steps vary: their last change is measured, too */
#endif
  first_points(&w, past, *steps);
  forces(&w);
  measure_points(&w, options);
  for (int k = 0; needs_iteration(&now); k++) {
    const number measured = measures_stiffness(&now, k);
    number change;
    measures = w.former && any_positive(measured);
    if (measures)
      keep_iterate(&w);
    change = implicit ? correct_points(&w) : improve(&w);
    forces(&w);
    if (measures)
      stiffness += measured * (measure_stiffness(&w) - stiffness);
    take_change(&now, change, options, k, report);
#ifndef ARRAYS
    if (is_stagnant(&now, options, k))
      measure_by_largest(stagnant(&now), inverse_size);
#endif
#ifndef POINTS
    if (converge_early(&now)) {
      store_early(&now, F[0], stored[0]);
      mark_stored(&now);
    }
#endif
  }
#ifndef POINTS
  restore_early(&now, stored[0], F[0]);
#endif
  TRY(outcome(&now, report));
  const int unmeasured = !any_positive(magnitude(stiffness));
  if (unmeasured && !has_remainder(&now, options))
    w.former = NULL;
  measures = unmeasured && w.former;
  if (implicit)
    refine_forces(&w);
  else if (!rough) {
    if (measures)
      keep_iterate(&w);
    refine_points(&w, own);
#ifdef ARRAYS
    improve_velocities(&w, own);
#endif
    forces(&w);
    if (measures)
      stiffness = measure_stiffness(&w);
    if (w.former)
      weigh_remainder(stiffness, step->h, &remainder);
  }
  if (!w.former)
    memset(&remainder, 0, sizeof remainder);
  if (rough)
    find_rough_increments(&w, dq, dp);
  else
    find_increments(&w, own, dq, dp);
  TRY(accept(step, dq, dp));
#ifndef ARRAYS
  remember_curve(F, past);
#endif
#if defined(ERROR_GROWTH) || defined(MIXED_POINTS)
  if (step->points)
    memcpy(step->points, X, sizeof X);
#endif
#ifdef POOR_GUESS
  if (implicit) {
    *steps = next_of_vibrations(*steps, now.first);
    return OK;
  }
#endif
  *steps = next_guess(*steps, &now, report);
  return OK;
}

/* The same with the linear part of the forces or, if that does not converge, without it. */
HOT int fixed_point(const step_data *step, const iteration_data *data, history past, long long *steps, number *dq,
    number *dp, const solver_options *options, solver_report *report)
{
  if (solves_linear_part(data) && iterate(step, data, past, steps, dq, dp, options, report, 1, 0) == OK)
    return OK;
  return iterate(step, data, past, steps, dq, dp, options, report, 0, 0);
}

#ifdef ROUGH
/* The same without low words, if `rough`. */
HOT int adaptive_point(const step_data *step, const iteration_data *data, history past, long long *steps, number *dq,
    number *dp, const solver_options *options, solver_report *report, int rough)
{
  if (rough && !solves_linear_part(data))
    return iterate(step, data, past, steps, dq, dp, options, report, 0, 1);
  return fixed_point(step, data, past, steps, dq, dp, options, report);
}
#endif
#endif

#ifdef RUN_ACTION
/* Integral along a solved step, whose forces `memory` contains. Requires: the table VELOCITY, the kernel
 * integrand_lanes. */
static inline void integrals_of_iteration(const step_data *step, const iteration_data *data, stored_forces memory,
    number *sum)
{
  coordinates u[2];
  lanes value[GROUPS];
  for (int g = 0; g < GROUPS; g++) {
    for (int i = 0; i < M; i++) {
      const number inverse = data->inverse_mass[i], v = inverse * step->p0[i];
      const lanes kick = sum_of_stored(VELOCITY, g, memory, i), displacement = sum_of_stored(PRODUCT, g, memory, i);
      u[0][i] = step->q0[i] + (step->h * v * DRIFT[g] + data->square * inverse * displacement);
      u[1][i] = v + step->h * inverse * kick;
    }
    integrand_lanes(u[0], step->t + step->h * ABSCISSA[g], step->parameters, &value[g]);
  }
  *sum = step->h * weigh_apart_twice(POINT_END_MOMENTUM, POINT_END_MOMENTUM_LOW, value, 1);
}
#endif
