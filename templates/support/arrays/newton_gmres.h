#include "../core/progress.h"
#include "../iteration/one_trajectory.h"
#include "array_newton.h"
#include "preconditioner.h"

/* Restarted GMRES with right preconditioning (Y. Saad, Iterative Methods for Sparse Linear Systems, 2003, algorithm
 * 9.5) on vectors over all points of all coordinates. Requires: linear_system with count, state and work; multiply,
 * precondition and reconsider. */

enum { MOST_CYCLES = 30 }; /* then Newton's method continues with the correction so far */

#define LINEAR_TOLERANCE 1e-6 /* relative residual: reduction per Newton iteration */
#define LINEAR_GRAIN (DBL_EPSILON / 4) /* relative to the state: a smaller residual is rounding */

/* Triangular factor of the Hessenberg matrix by Givens rotations, and the rotated right-hand side. */
typedef struct {
  double column[BASIS][BASIS + 1], cosine[BASIS], sine[BASIS], rest[BASIS + 1];
} triangle;

/* Applies the previous rotations and a new one to column k; returns the norm of the residual. */
static double rotate(triangle *of, int k)
{
  double *column = of->column[k], length;
  for (int j = 0; j < k; j++) {
    const double upper = column[j], lower = column[j + 1];
    column[j] = of->cosine[j] * upper + of->sine[j] * lower;
    column[j + 1] = of->cosine[j] * lower - of->sine[j] * upper;
  }
  length = sqrt(column[k] * column[k] + column[k + 1] * column[k + 1]);
  of->cosine[k] = length > 0.0 ? column[k] / length : 1.0;
  of->sine[k] = length > 0.0 ? column[k + 1] / length : 0.0;
  column[k] = length;
  of->rest[k + 1] = -of->sine[k] * of->rest[k];
  of->rest[k] *= of->cosine[k];
  return fabs(of->rest[k + 1]);
}

/* Builds the Arnoldi basis of one cycle until the residual is below `enough`; returns its size. */
static int build_basis(linear_system *of, triangle *all, double enough, solver_report *report)
{
  for (int k = 0; k < BASIS; k++) {
    const lanes *now = of->work->basis + k * of->count;
    lanes *next = of->work->basis + (k + 1) * of->count;
    double left;
    precondition(of, now, of->work->product);
    multiply(of, of->work->product, next);
    report->products++;
    for (int j = 0; j <= k; j++) {
      const double part = inner_product(of, of->work->basis + j * of->count, next);
      all->column[k][j] = part;
      add_multiple(of, next, -part, of->work->basis + j * of->count);
    }
    all->column[k][k + 1] = sqrt(inner_product(of, next, next));
    if (all->column[k][k + 1] > 0.0)
      set_multiple(of, next, 1.0 / all->column[k][k + 1], next);
    left = rotate(all, k);
    if (!(left > enough))
      return k + 1;
  }
  return BASIS;
}

/* Adds the solution in a basis of `size` vectors to the correction. */
static void add_combination(linear_system *of, triangle *all, int size)
{
  lanes *sum = of->work->basis + size * of->count;
  for (int k = size - 1; k >= 0; k--) {
    for (int j = k + 1; j < size; j++)
      all->rest[k] -= all->column[j][k] * all->rest[j];
    all->rest[k] = all->column[k][k] != 0.0 ? all->rest[k] / all->column[k][k] : 0.0;
  }
  make_zero(of, sum);
  for (int k = 0; k < size; k++)
    add_multiple(of, sum, all->rest[k], of->work->basis + k * of->count);
  precondition(of, sum, of->work->product);
  add_multiple(of, of->work->correction, 1.0, of->work->product);
}

/* Solves for the correction to LINEAR_TOLERANCE or LINEAR_GRAIN; returns the norm of the residual, which is larger if
 * further cycles do not reduce it. Rounding errors of large coordinates may exceed small ones, so the residual that is
 * left at that level is corrected by the inverses of the coordinates. */
static double find_correction(linear_system *of, solver_report *report)
{
  const double size = sqrt(inner_product(of, of->work->residual, of->work->residual));
  const double enough = larger(LINEAR_TOLERANCE * size, LINEAR_GRAIN * of->state);
  double last = size;
  make_zero(of, of->work->correction);
  for (int cycle = 0; cycle < MOST_CYCLES; cycle++) {
    triangle all = {.rest = {0.0}};
    lanes *left = of->work->basis;
    set_multiple(of, left, 1.0, of->work->residual);
    if (cycle > 0) {
      multiply(of, of->work->correction, of->work->product);
      add_multiple(of, left, -1.0, of->work->product);
    }
    all.rest[0] = sqrt(inner_product(of, left, left));
    if (!(all.rest[0] > enough && all.rest[0] < INFINITY)) {
      if (enough > LINEAR_TOLERANCE * size && !of->by_fourier && !of->by_factors) {
        precondition(of, left, of->work->product);
        add_multiple(of, of->work->correction, 1.0, of->work->product);
      }
      return all.rest[0];
    }
    if (cycle > 0)
      choose_preconditioner(of, all.rest[0] / last);
    last = all.rest[0];
    set_multiple(of, left, 1.0 / all.rest[0], left);
    add_combination(of, &all, build_basis(of, &all, enough, report));
  }
  return last;
}

/* Newton's method for the points of a step of an array system. */

#define REFRESHED 1e-6 /* squared: the preconditioner is recomputed while points change by more than 1e-3 of the
                        * state */
#define SLOW 0.1 /* squared: corrections by the factors have to decrease by more, otherwise these are computed again,
                  * then GMRES solves the linear systems */
#define UNSOLVED 1e-10 /* relative to the state: a larger residual is not due to rounding */

/* Residual: the change by one fixed-point iteration at the points with their forces, for the coordinates of this
 * thread. */
static void find_residual(linear_system *of, const step_points *w)
{
  for (int part = 0; part < X_VECTORS; part++)
    for (long long i = of->own.first; i < of->own.end; i++)
      for (int g = 0; g < GROUPS; g++)
        of->work->residual[(g * X_VECTORS + part) * w->n + i] = residual_at(w, part, g, i);
}

/* Squared scaled size of the state in the step. */
static double size_of_state(const linear_system *of)
{
  const step_points *w = of->points;
  sums all;
  EACH_BLOCK (all, w->step) {
    double size = 0.0;
    for (int part = 0; part < X_VECTORS; part++)
      for (long long i = all.here.first; i < all.here.end; i++) {
        const double end = at_point(&w->X[part * w->n + i], X_VECTORS * w->n, KEPT - 1);
        const double of_one = of->scale[part] * (drifted_size(w, part, i) + fabs(end - start_at(w, part, i)));
        size += of_one * of_one;
      }
    add_block(&all, size, 0.0);
  }
  meet(w->step);
  return sum_of(&all, 0);
}

/* Starts from the extrapolated points or from points without forces, whichever has the smaller residual: the forces of
 * a stiff system have no curve that could be extrapolated. */
static void start_nearer(linear_system *of)
{
  const step_points *w = of->points;
  step_points rest = *w;
  double continued, at_rest;
  rest.X = of->work->correction, rest.F = of->work->forces;
  find_residual(of, w);
  continued = inner_product(of, of->work->residual, of->work->residual);
  for (int g = 0; g < ROWS; g++)
    for (long long i = of->own.first; i < of->own.end; i++)
      rest.X[g * of->n + i] = unforced_at(w, g % X_VECTORS, g / X_VECTORS, i);
  forces(&rest);
  find_residual(of, &rest);
  at_rest = inner_product(of, of->work->residual, of->work->residual);
  if (continued <= at_rest)
    return;
  set_multiple(of, w->X, 1.0, rest.X);
  for (int g = 0; g < GROUPS * F_VECTORS; g++)
    for (long long i = g * of->n + of->own.first; i < g * of->n + of->own.end; i++)
      w->F[i] = rest.F[i];
}

/* Scales the parts of the state by the largest value at the start of the step, or displacement by the drift or by the
 * first force: for a step from rest at 0 the only size. */
static void find_scales(linear_system *of, const solver_options *options)
{
  const step_points *w = of->points;
  double size[SUMS];
  sums all;
  EACH_BLOCK (all, w->step) {
    for (int part = 0; part < X_VECTORS; part++) {
      size[part] = DBL_MIN;
      for (long long i = all.here.first; i < all.here.end; i++)
        size[part] = larger(size[part], first_size(w, part, i));
    }
    add_values(&all, size, X_VECTORS);
  }
  meet(w->step);
  for (int part = 0; part < X_VECTORS; part++)
    size[part] = largest_over(&all, part);
  for (int part = 0; part < X_VECTORS; part++) {
    const double own = size[part] > DBL_MIN ? size[part] : size[X_VECTORS - 1 - part];
    of->scale[part] = X_VECTORS == 1 || options->absolute ? scale_of(own) : 1.0 / own;
  }
}

/* Returns 1 if further corrections of the same rate would exceed the tolerance: linear convergence without a final
 * iteration. */
static int leaves_more(const progress *now, const solver_options *options)
{
  const double rate = smaller(now->last / now->before, SLOWEST_CONVERGENCE);
  return now->last < now->before && MARGIN * rate * now->last > options->tolerance * options->tolerance;
}

typedef iteration_data solver_data;

#define prepare prepare_iteration

/* Computes the increments of one step: iterates until the points, extrapolated from *guess steps, converge. On success
 * *guess is the number of steps for the next predictor. */
static int solve(const step_data *step, const solver_data *data, history past, long long *guess, double *dq, double *dp,
    const solver_options *options, solver_report *report, double *workspace)
{
  const step_points w = points_in(step, data, past);
  linear_system of = {.step = step, .run = step->run, .points = &w, .work = step->work, .n = step->n};
  progress now = before_iterations();
  const int direct = step->run->pattern || X_VECTORS == 2; /* corrections by the preconditioner without GMRES */
  int slow = 0; /* iterations with the factors that reduced the change too little */
  of.count = ROWS * of.n, of.own = own_part(step), of.by_factors = step->run->pattern != NULL;
  first_points(&w, past, *guess);
  forces(&w);
  find_scales(&of, options);
  start_nearer(&of);
  of.state = sqrt(size_of_state(&of));
  for (int k = 0; needs_iteration(&now); k++) {
    const int no_factors = of.by_factors && *envelope_of(&of).valid_for != step->h;
    double change, size, left;
    find_residual(&of, &w);
    if (!direct             ? now.last > REFRESHED /* also before the first iteration */
            : of.by_factors ? no_factors || slow == 1 || (k == 0 && step->first == COMPARISON)
                            : k == 0 || slow == 1)
      find_inverses(&of);
    left = 0.0;
    if (direct && slow < 2)
      precondition(&of, of.work->residual, of.work->correction);
    else
      left = find_correction(&of, report);
    add_multiple(&of, w.X, 1.0, of.work->correction);
#ifdef FORCES_OF_VELOCITIES
    find_positions(&w);
#endif
    forces(&w);
    change = inner_product(&of, of.work->correction, of.work->correction);
    of.state = sqrt(size_of_state(&of));
    size = options->absolute ? of.scale[0] * of.scale[0] : of.state * of.state;
    slow += k > 0 && relative_change(change, size) > larger(SLOW * now.last, PROGRESS_LEVEL);
    take_change(&now, relative_change(change, size), options, k, report);
    if (now.status > 0 && direct && leaves_more(&now, options))
      now.status = 0;
    if (now.status > 0 && !(left <= UNSOLVED * of.state)) /* an unsolved linear system does not count as a small
                                                           * correction */
      now.status = -1, now.last = left;
  }
  TRY(outcome(&now, report));
  find_increments(&w, own_part(step), dq, dp);
  *guess = next_guess(*guess, &now, report);
  return accept(step, dq, dp);
}
