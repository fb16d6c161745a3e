/* Runs whose arguments and results are one struct. Requires: NAME, STATUS, calls_declarations.h; HAS_ADVANCE_TO,
 * HAS_PROJECT, HAS_SET_FALLBACK, and HAS_ and the optional fields of a run where the source has these; HAS_CONSTRAINTS
 * of named coordinates, with DEPENDENT, INPUT_PRECISION and ROUNDING_OF_INPUT (projection.py). Functions are
 * called by volatile pointers: not inlined, so that the bits of steps do not depend on these callers. */
#include <float.h>
#include <math.h>

enum { IN_DOUBT = -1, /* status of a call; how a run begins: */
  BY_VELOCITY = 1,
  ON_CONSTRAINTS = 2 };

static int NAME(call_store)(const NAME(call) *c, long long row, long long steps, long long every)
{
  double *t = c->t + row * c->words, *q = c->q + row * c->coordinates, *p = c->p + row * c->coordinates;
  __typeof__(NAME(advance)) *volatile fixed = NAME(advance);
#ifdef HAS_ADVANCE_TO
  __typeof__(NAME(advance_to)) *volatile adaptive = NAME(advance_to);
  if (c->control)
    return adaptive(c->run, c->t_end, c->control, steps, every, c->parameters, c->options, t, q, p,
        c->iterations + row, c->report, c->workspace);
#endif
  return fixed(c->run, steps, every, c->parameters, c->options, t, q, p, c->iterations + row, c->report, c->workspace);
}

/* Takes steps and stores states. */
int NAME(call_advance)(const NAME(call) *call, long long steps, long long every)
{
  return NAME(call_store)(call, 0, steps, every);
}

#ifdef HAS_CONSTRAINTS
#include <stdlib.h>

/* Divides a row by its length, which is returned; NaN if that is 0 or not finite. */
static double NAME(call_shorten)(double *row)
{
  double square = 0.0;
  for (int i = 0; i < M; i++)
    square += row[i] * row[i];
  const double length = square > 0.0 && square < INFINITY ? sqrt(square) : NAN;
  for (int i = 0; i < M; i++)
    row[i] /= length;
  return length;
}

/* Returns 1 if the rows of G are certainly independent. Of rows of length 1, with the distance r_k of each from the span
 * of those before, the product of r_k^2 is det G G^T, that of the squared singular values, which add up to their number
 * c: the least of them is at least prod r_k^2 ((c - 1) / c)^(c - 1) > prod r_k^2 / e. */
static int NAME(call_independent)(const double *derivative)
{
  double(*row)[M] = calloc(CONSTRAINTS, sizeof *row), product = row ? exp(-0.5) : 0.0;
  for (int e = 0; row && e < CONSTRAINT_ENTRIES; e++)
    row[CONSTRAINT_ENTRY[e][0]][CONSTRAINT_ENTRY[e][1]] = derivative[e];
  for (int k = 0; k < CONSTRAINTS && product > DEPENDENT; k++) {
    NAME(call_shorten)(row[k]);
    for (int j = 0; j < k; j++) {
      double along = 0.0;
      for (int i = 0; i < M; i++)
        along += row[k][i] * row[j][i];
      for (int i = 0; i < M; i++)
        row[k][i] -= along * row[j][i];
    }
    product *= NAME(call_shorten)(row[k]);
  }
  free(row);
  return product > DEPENDENT;
}

/* Nearest state on the constraints, or the state itself within rounding errors; returns 1 if it is in doubt whether it
 * is right: far away, where constraints may be dependent, or where a velocity has no momentum. */
int NAME(call_consistent)(double t, const double *q, const double *p, const double *parameters, double *q1, double *p1,
    double *workspace)
{
  double apart[2], moved, u[2 * M] = {0}, momentum[M], mass[MASS_ENTRIES], g[CONSTRAINTS], derivative[CONSTRAINT_ENTRIES];
  int moves[M] = {0}, all = 1;
  if (NAME(project)(t, q, p, parameters, q1, p1, workspace) ||
      NAME(apart)(t, q, p, q1, p1, parameters, apart, workspace))
    return 1;
  moved = fmax(apart[0], apart[1]);
  memcpy(u, q1, sizeof(double) * M);
  legendre(u, t, parameters, momentum, mass);
  constraints(u, t, parameters, g, derivative);
  for (int e = 0; e < MASS_ENTRIES; e++)
    moves[MASS_ENTRY[e][1]] |= mass[e] != 0.0;
  for (int i = 0; i < M; i++)
    all &= moves[i];
  if (!(all && moved <= INPUT_PRECISION && NAME(call_independent)(derivative)))
    return 1;
  if (moved <= ROUNDING_OF_INPUT) {
    memcpy(q1, q, sizeof(double) * M);
    memcpy(p1, p, sizeof(double) * M);
  }
  return 0;
}
#endif

/* Sets the first state of a run, (q, v) or (q, p) as `begins_by` says; returns 1 if it is in doubt whether a velocity has
 * a momentum, or as call_consistent. */
static int NAME(call_begin)(const NAME(call) *c)
{
  const double *q = c->start + 1, *given = q + c->coordinates;
  const size_t size = sizeof(double) * (size_t)c->coordinates;
  double *p = c->p;
  c->t[0] = c->start[0];
  c->iterations[0] = 0;
  memcpy(c->q, q, size);
#ifndef HAS_H_LOW
  if (c->begins_by & BY_VELOCITY) {
    if (NAME(momentum)(c->t[0], q, given, c->parameters, p, c->workspace))
      return 1;
    for (long long i = 0; i < c->coordinates; i++)
      if (p[i] == 0.0 && given[i] != 0.0)
        return 1;
    given = p;
  }
#endif
#ifdef HAS_CONSTRAINTS
  if (c->begins_by & ON_CONSTRAINTS) {
    double momenta[M];
    memcpy(momenta, given, size);
    return NAME(call_consistent)(c->t[0], q, momenta, c->parameters, c->q, p, c->workspace);
  }
#endif
  if (given != p)
    memcpy(p, given, size);
  return 0;
}

/* Returns 1 for a run of which there may be a warning: of a large step, or a changed energy, both unless certainly below
 * `tolerable`, or of errors that grow. */
static int NAME(call_remarks)(const NAME(call) *c)
{
  const double *e = c->energies, change = fabs(e[1] - e[0]);
  const int is_accurate = c->error >= 0.0 && c->error <= c->tolerable;
#ifdef HAS_MEASURES_GROWTH
  if (c->measures_growth && !(c->run->tangent_steps && c->run->growth <= c->run->growth_limit))
    return 1;
#endif
  const int keeps = !c->has_energies || !c->control ||
      change <= 0.5 * c->tolerable * fmax(fabs(e[0]), fabs(e[1]));
  return !(is_accurate && keeps);
}

/* Starts a run, takes steps and stores states, the initial one first; returns IN_DOUBT where call_begin is. */
int NAME(call_integrate)(NAME(call) *c, long long steps, long long every)
{
  if (NAME(call_begin)(c))
    return IN_DOUBT;
  NAME(start)(c->run, c->t[0], c->h, c->q, c->p);
#ifdef HAS_MEASURES_GROWTH
  c->run->measures_growth = c->measures_growth;
#endif
  int status = NAME(call_store)(c, 1, steps, every);
  c->steps = c->report->steps;
  c->stored = c->steps / every;
  c->error = NAME(step_error)(c->run);
  c->error_t = c->run->error_t;
#ifdef HAS_ADVANCE_TO
  c->stored = c->control ? c->report->stored : c->stored;
#endif
#ifdef HAS_REJECTED
  c->rejected = c->run->rejected;
#endif
#ifdef HAS_FALLBACK_STEPS
  c->fallback_steps = c->run->fallback_steps;
#endif
  if (c->control && c->sizes)
    for (long long k = 0; k < c->stored; k++)
      c->sizes[k] = c->t[k + 1] - c->t[k];
  long long last = c->stored, row = last * c->coordinates;
  if (!status && c->control && c->has_energies &&
      (NAME(energies)(1 + (last == 1), c->t, c->q, c->p, c->parameters, c->energies, c->workspace) ||
          (last != 1 &&
              NAME(energies)(1, c->t + last, c->q + row, c->p + row, c->parameters, c->energies + 1, c->workspace))))
    c->energies[0] = c->energies[1] = 0.0; /* undefined */
  c->remarks = NAME(call_remarks)(c);
  return status;
}

#ifdef HAS_ERRORS
/* Takes `parts` equal steps h from the state after a vector v times a factor, whose low words are in compensation
 * terms. */
static int NAME(call_step)(NAME(call) *c, double t, double h, long long parts, const double *q, const double *p,
    const double *v, double factor)
{
  __typeof__(NAME(advance)) *volatile fixed = NAME(advance);
  NAME(run) *run = c->run;
  run->guess = v && run->h != h ? 0 : run->guess; /* predictors are those of equal steps */
  run->t = t, run->t_low = 0.0, run->h = h;
  for (int i = 0; i < M; i++) {
    const double dq = v ? factor * v[i] : 0.0, dp = v ? factor * v[M + i] : 0.0;
    run->q[i] = q[i] + dq, run->carry_q[i] = fabs(dq) > fabs(q[i]) ? (dq - run->q[i]) + q[i] : (q[i] - run->q[i]) + dq;
    run->p[i] = p[i] + dp, run->carry_p[i] = fabs(dp) > fabs(p[i]) ? (dp - run->p[i]) + p[i] : (p[i] - run->p[i]) + dp;
  }
  return fixed(run, parts, parts, c->parameters, c->options, NULL, NULL, NULL, NULL, c->report, c->workspace);
}

#endif

/* Takes `pieces` equal steps h from each of `count` states q, p at times t; their ends are q1, p1. */
int NAME(call_pieces)(NAME(call) *c, long long count, const double *t, const double *h, const long long *pieces,
    const double *q, const double *p, double *q1, double *p1)
{
  int status = 0;
  for (long long k = 0; k < count && !status; k++) {
    const long long row = k * c->coordinates;
#ifdef HAS_ERRORS
    if (k == 0)
      NAME(start)(c->run, t[0], h[0], q, p);
    status = NAME(call_step)(c, t[k], h[k], pieces[k], q + row, p + row, NULL, 0.0);
    for (int i = 0; i < M; i++)
      q1[row + i] = c->run->q[i], p1[row + i] = c->run->p[i];
#else
    __typeof__(NAME(advance)) *volatile fixed = NAME(advance);
    double end[2];
    int iterations;
    NAME(start)(c->run, t[k], h[k], q + row, p + row);
    status = fixed(c->run, pieces[k], pieces[k], c->parameters, c->options, end, q1 + row, p1 + row, &iterations,
        c->report, c->workspace);
#endif
  }
  return status;
}

#ifdef HAS_ERRORS
#ifdef HAS_SET_FALLBACK
#define LACKS_NEWTON(status) ((status) == STATUS(FALLBACK_REQUIRED))
#else
#define LACKS_NEWTON(status) 0
#endif
#define MOST_PARTS 16 /* of a step that the iteration does not solve, before Newton's method is loaded */

#if defined(KEPT) && (defined(SUPPORT_SEPARABLE_ITERATION_H) || defined(SUPPORT_COUPLED_ITERATION_H))
#define HAS_CURVES
#endif

/* Number of the points at which a run keeps forces or velocities of the last step, and their abscissae unless NULL. */
int NAME(call_abscissae)(double *abscissae, int *count)
{
#ifdef HAS_CURVES
  *count = KEPT;
  for (int j = 0; abscissae && j < KEPT; j++)
    abscissae[j] = VECTOR_ENTRY(ABSCISSA, j);
#else
  (void)abscissae;
  *count = 0;
#endif
  return 0;
}

/* Copies these values, M of each point, of a step that the iteration solved; NaN: there are none. Returns the next. */
static double *NAME(call_keep)(const NAME(run) *run, int parts, double *curve)
{
#ifdef HAS_CURVES
  for (int i = 0; curve && i < M; i++)
    for (int j = 0; j < KEPT; j++)
      *curve++ = parts == 1 && run->guess > 0 ? run->memory[i * POINTS + j] : NAN;
#else
  (void)run, (void)parts;
#endif
  return curve;
}

/* Length of a vector in units of sizes; infinite where a component other than 0 has the size 0. */
static double NAME(relative_length)(int count, const double *x, const double *size)
{
  double sum = 0.0;
  for (int i = 0; i < count; i++)
    sum += x[i] == 0.0 ? 0.0 : x[i] / size[i] * (x[i] / size[i]);
  return sqrt(sum);
}

/* Error x[k + 1] - y[k + 1] after the step phi of y[k] = x[k] - error, x[k] = (q, p) at t, in `parts` equal steps from
 * states with low words, so that no rounding of states remains. Returns 0 if a step fails or Newton's method solves one,
 * unless that is accepted; then the negative status where it is not there. */
static int NAME(call_error)(NAME(call) *c, double t, double h, long long parts, int by_newton, const double *q,
    const double *p, const double *error, double *next)
{
  NAME(run) *run = c->run;
  const int status = NAME(call_step)(c, t, h / (double)parts, parts, q, p, error, -1.0);
  if (status || (c->report->fallback_steps && !by_newton))
    return by_newton && LACKS_NEWTON(status) ? -status : 0;
  for (int i = 0; i < M; i++) {
    next[i] = (q[M + i] - run->q[i]) - run->carry_q[i];
    next[M + i] = (p[M + i] - run->p[i]) - run->carry_p[i];
  }
  return 1;
}

#define CARRIED 4.0 /* ranges are twice the amplitudes, and some derivatives twice those of an oscillator */

/* Returns 1 if phi in half as many steps, or the motion, shows that the error of phi is small beside the change of the
 * error: this is below limits[0] of the change of momenta, the motion by forces, or the last one differs from it by
 * limits[1] of it and roundings (Hairer, Norsett & Wanner, Solving ODEs I, II.4). After a step of which the first is known,
 * it also contains (D phi - 1) error, of the size of the motion times the error. Lengths are relative to sizes of (q, p). */
static int NAME(call_resolved)(const double *q, const double *p, const double *size, const double *limits,
    const double *error, const double *next, const double *last, int follows)
{
  double moved[2 * M], change[2 * M], apart[2 * M];
  for (int i = 0; i < 2 * M; i++) {
    const double *x = i < M ? q + i : p + i - M;
    moved[i] = x[M] - x[0];
    change[i] = next[i] - error[i];
    apart[i] = last ? fmax(fabs(next[i] - last[i]) - limits[2] * (fabs(x[0]) + fabs(moved[i])), 0.0) : INFINITY;
  }
  const double length = NAME(relative_length)(2 * M, change, size);
  const double by_forces = NAME(relative_length)(M, moved + M, size + M);
  const double carried = NAME(relative_length)(2 * M, error, size) * NAME(relative_length)(2 * M, moved, size);
  return length <= limits[0] * by_forces + (follows ? CARRIED * carried : 0.0) ||
      NAME(relative_length)(2 * M, apart, size) <= limits[1] * length;
}

/* Takes a step of phi in twice as many parts, from *least on, until it is resolved, and replaces the error by the next
 * one; returns the number of parts, or 0. *least becomes that which can be solved, or more than MOST_PARTS, and *follows
 * whether the motion showed that. */
static int NAME(call_parts)(NAME(call) *c, double t, double h, int by_newton, const double *q, const double *p,
    const double *size, const double *limits, double *error, int *least, int *follows)
{
  const NAME(run) before = *c->run;
  double next[2 * M] = {0.0}, last[2 * M];
  int solved = 0, known = *follows;
  *follows = 0;
  for (int parts = *least; parts <= MOST_PARTS; parts *= 2) {
    const int halved = solved;
    memcpy(last, next, sizeof last);
    *c->run = before;
    solved = NAME(call_error)(c, t, h, parts, by_newton, q, p, error, next);
    if (solved < 0)
      return solved;
    if (solved && NAME(call_resolved)(q, p, size, limits, error, next, halved ? last : NULL, known)) {
      memcpy(error, next, sizeof next);
      *follows = parts == *least;
      return parts;
    }
    *least = solved ? *least : 2 * parts;
  }
  return 0;
}

/* Length of a change of the error relative to that of the state in its step, a power of 2, so that sizes, which later
 * states change, do not change bits. */
static double NAME(call_change)(const double *q, const double *p, const double *size, const double *error,
    const double *next)
{
  double change[2 * M], moved[2 * M];
  for (int i = 0; i < M; i++)
    moved[i] = q[M + i] - q[i], moved[M + i] = p[M + i] - p[i];
  for (int i = 0; i < 2 * M; i++)
    change[i] = next[i] - error[i];
  const double part = NAME(relative_length)(2 * M, change, size) / NAME(relative_length)(2 * M, moved, size);
  return part > 0.0 && part < INFINITY ? exp2(floor(log2(part))) : 0.0;
}

/* Errors x - y of `count` states of a run x after the first one, with the error `before`, beside states y by steps phi
 * of its sizes h, into the columns of `errors`, until one is resolved in no number of parts: c->steps states. A step
 * that the iteration does not solve is taken in parts; where that does not suffice, Newton's method solves all further
 * ones. Iterations leave limits[3] of the change of the error before. Values of the steps at their points go into
 * curves. */
int NAME(call_errors)(NAME(call) *c, long long count, const double *t, const double *h, const double *q,
    const double *p, const double *size, const double *limits, const double *before, double *curves, long long stride,
    double *errors)
{
  int least = 1, by_newton = 0, follows = 0;
  double error[2 * M], last[2 * M];
  const NAME(options) exact = c->options ? *c->options : NAME(default_options)();
  NAME(options) options = exact;
  NAME(call) at = *c; /* the caller may call again, with its own options */
  at.options = &options;
  memcpy(error, before, sizeof error);
  NAME(start)(c->run, t[0], h[0], q, p);
  for (long long k = 0; k < count; k++, q += M, p += M) {
    memcpy(last, error, sizeof last);
    int parts = NAME(call_parts)(&at, t[k], h[k], by_newton, q, p, size, limits, error, &least, &follows);
    c->steps = k;
    if (least > MOST_PARTS) {
      NAME(start)(c->run, t[k], h[k], q, p);
      least = by_newton = 1;
      parts = NAME(call_parts)(&at, t[k], h[k], by_newton, q, p, size, limits, error, &least, &follows);
      least = 1;
    }
    if (parts <= 0)
      return -parts;
    options.tolerance = fmax(exact.tolerance, limits[3] * NAME(call_change)(q, p, size, last, error));
    curves = NAME(call_keep)(c->run, parts, curves);
    for (int i = 0; i < 2 * M; i++)
      errors[i * stride + k] = error[i];
  }
  c->steps = count;
  return 0;
}

/* Transports samples of rounding errors, from `before` to `now`, over the steps psi of a run by differences: psi(x + s
 * v) - psi(x) = s D psi v + O(s^2), with s v_i = sqrt(u |x_i| size_i) at most, where rounding errors and the terms in
 * s^2 are alike (W. H. Press et al., Numerical Recipes, 5.7). */
int NAME(call_differences)(NAME(call) *c, long long count, const double *t, const double *h, const double *q,
    const double *p, const double *size, int vectors, double rounding, unsigned long long seed, const double *before,
    double *now, long long stride, double *deviations)
{
  rounding_vectors all = {vectors, 2 * M, rounding, seed, stride, deviations};
  NAME(run) *run = c->run, last;
  int status = 0;
  memcpy(now, before, sizeof(double) * (size_t)(vectors * 2 * M));
  NAME(start)(run, t[0], h[0], q, p);
  for (long long k = 0; k < count && !status; k++, q += M, p += M) {
    last = *run;
    for (int j = 0; j < vectors && !status; j++) {
      double *v = now + j * 2 * M, largest = 0.0;
      for (int i = 0; i < 2 * M; i++)
        largest = fmax(largest, fabs(v[i]) / sqrt(size[i]) / sqrt(fmax(size[i], fabs(i < M ? q[i] : p[i - M]))));
      if (largest == 0.0)
        continue;
      const double factor = sqrt(DBL_EPSILON) / largest;
      *run = last;
      status = NAME(call_step)(c, t[k], h[k], 1, q, p, v, factor);
      for (int i = 0; i < M; i++) {
        v[i] = ((run->q[i] - q[M + i]) + run->carry_q[i]) / factor;
        v[M + i] = ((run->p[i] - p[M + i]) + run->carry_p[i]) / factor;
      }
    }
    double x[2 * M];
    memcpy(x, q + M, sizeof(double) * M), memcpy(x + M, p + M, sizeof(double) * M);
    if (!status)
      receive_roundings(&all, k, x, now);
  }
  return status;
}
#endif

/* Advances the present trajectory by at most `steps` steps; returns 1 at its end. */
static int NAME(call_one)(NAME(each) *c, const double *parameters, long long steps, long long *taken)
{
  const long long j = c->next, m = c->coordinates, begun = c->run->step, row = c->rows;
  double *t = c->times + row * c->words, *q = c->positions + row * m, *p = c->momenta + row * m;
  __typeof__(NAME(advance)) *volatile fixed = NAME(advance);
  int status = 0, arrived = 0;
#ifdef HAS_ACTIONS
  c->run->actions = c->actions ? c->actions + row : NULL;
#endif
#ifdef HAS_SET_FALLBACK
  const long long left = c->left;
  *c->before = *c->run;
#endif
  if (!c->control) {
    const long long every = c->segment_every[c->segment], size = steps < c->left ? steps : c->left;
    status = fixed(c->run, size, every, parameters, c->options, t, q, p, c->iterations + row, c->report, c->workspace);
    c->left -= size;
    c->rows += c->run->step / every - begun / every;
  }
#ifdef HAS_ADVANCE_TO
  __typeof__(NAME(advance_to)) *volatile adaptive = NAME(advance_to);
  if (c->control) {
    status = adaptive(c->run, c->t_end[j], c->control, steps, c->every, parameters, c->options, t, q, p,
        c->iterations + row, c->report, c->workspace);
    c->rows += c->report->stored;
    arrived = c->run->t == c->t_end[j] && c->run->t_low == 0.0;
  }
#endif
#ifdef HAS_SET_FALLBACK
  if (status == STATUS(FALLBACK_REQUIRED)) { /* the state before this call */
    *c->run = *c->before;
    c->rows = row;
    c->left = left;
    c->requested = 1;
    return 0;
  }
#endif
  *taken += c->run->step - begun;
  c->stored[j] += c->rows - row;
  c->done[j] = c->run->step;
#ifdef HAS_FALLBACK_STEPS
  c->fallback_steps[j] = c->run->fallback_steps;
#endif
  if (c->energies && arrived && !status && c->rows > row) {
    const long long last = (c->rows - 1) * m;
    double *energy = c->energies + 2 * j;
    if (NAME(energies)(1, &c->t, c->q + j * m, c->p + j * m, parameters, energy, c->workspace) ||
        NAME(energies)(1, c->times + c->rows - 1, c->positions + last, c->momenta + last, parameters, energy + 1,
            c->workspace))
      energy[0] = energy[1] = 0.0; /* undefined */
  }
  while (!status && !c->control && c->left == 0 && ++c->segment < c->segments) {
    c->left = c->segment_steps[c->segment];
    if (c->segment_h[c->segment] != c->run->h) {
      c->run->h = c->segment_h[c->segment];
      c->run->guess = 0;
    }
#ifdef HAS_H_LOW
    set_step_to(c->segment_end[c->segment], c->run->t, c->run->t_low, &c->run->h, &c->run->h_low);
    if (c->segment_end[c->segment] == c->segment_end[c->segment]) { /* from the state alone, without third words */
      const size_t low = (size_t)(m / c->words);
      memset(c->run->carry_q + low, 0, sizeof c->run->carry_q - low * sizeof(double));
      memset(c->run->carry_p + low, 0, sizeof c->run->carry_p - low * sizeof(double));
    }
#endif
    c->entered = c->pauses;
  }
  arrived |= status || (!c->control && c->segment == c->segments);
  c->status[j] = arrived ? status : -1;
  return arrived;
}

/* Advances trajectories one after the other, from `next` to `end`, by at most `steps` steps in all, and returns their
 * number; ends earlier if the memory for states is full, or if a step requests Newton's method. */
long long NAME(call_each)(NAME(each) *c, long long steps)
{
  long long taken = 0;
  c->requested = c->entered = 0;
  while (c->next < c->end && taken < steps && !c->requested && !c->entered) {
    const long long j = c->next, m = c->coordinates, room = c->capacity - c->rows - 2;
    long long size = steps - taken;
    if (room < 1)
      break;
    if (c->segment < 0) {
      NAME(start)(c->run, c->t, c->control ? 0.0 : c->segment_h[0], c->q + j * m, c->p + j * m);
#ifdef HAS_SEED
      c->run->seed = c->seed, c->run->trajectory = c->trajectory + j, c->run->metropolis = c->metropolis;
#endif
      c->segment = 0;
      c->left = c->control ? 0 : c->segment_steps[0];
#ifdef HAS_H_LOW
      c->run->t_low = c->t_low;
      if (!c->control)
        set_step_to(c->segment_end[0], c->run->t, c->run->t_low, &c->run->h, &c->run->h_low);
#endif
      if ((c->entered = c->pauses))
        break;
    }
    const long long every = c->control ? c->every : c->segment_every[c->segment];
    size = size / every > room - 1 ? room * every - every : size;
    if (size < 1)
      break;
    if (NAME(call_one)(c, c->parameters + j * c->parameters_each, size, &taken)) {
      c->next++;
      c->segment = -1;
    }
  }
  return taken;
}

#ifndef HAS_H_LOW
/* Momenta or velocities of states with parameters in common; returns the number of states before a failure. */
long long NAME(call_transform)(int to_velocities, long long count, long long m, const double *t, const double *q,
    const double *x, const double *parameters, double *y, double *workspace)
{
  __typeof__(NAME(momentum)) *function = to_velocities ? NAME(velocity) : NAME(momentum);
  long long k = 0;
  while (k < count && !function(t[k], q + k * m, x + k * m, parameters, y + k * m, workspace))
    k++;
  return k;
}

/* Momenta of states with velocities v and parameters of their own; returns the number of states before a failure. */
long long NAME(call_momenta)(long long count, double t, long long m, long long parameters_each, const double *q,
    const double *v, const double *parameters, double *p, double *workspace)
{
  long long k = 0;
  while (k < count && !NAME(momentum)(t, q + k * m, v + k * m, parameters + k * parameters_each, p + k * m, workspace))
    k++;
  return k;
}
#endif

#if defined(HAS_PROJECT) && !defined(HAS_H_LOW)
/* Projections (q1, p1) of states with parameters of their own, and their distances, NaN after a failure. */
void NAME(call_project)(long long count, double t, long long m, long long parameters_each, const double *q,
    const double *p, const double *parameters, double *q1, double *p1, double *apart, double *workspace)
{
  for (long long k = 0; k < count; k++, q += m, p += m, q1 += m, p1 += m, parameters += parameters_each, apart += 2)
    if (NAME(project)(t, q, p, parameters, q1, p1, workspace) ||
        NAME(apart)(t, q, p, q1, p1, parameters, apart, workspace))
      apart[0] = apart[1] = NAN;
}
#endif
