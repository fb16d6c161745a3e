#ifndef SUPPORT_ONE_TRAJECTORY_H
#define SUPPORT_ONE_TRAJECTORY_H

#include "../core/points.h"
#include "../core/step.h"

/* Predictor of the fixed-point iteration of one trajectory. Requires: points.h, step.h, and the tables LAST_ALONE,
 * LAST, BEFORE, which extrapolate stored values into the next step. */

/* Tables of the predictor. */
static inline struct predictor_tables_of tables_of(const step_data *step)
{
  const struct predictor_tables_of of_one_length = {LAST_ALONE, LAST, BEFORE};
  return step->tables ? *step->tables : of_one_length;
}

/* Stored values at the points, of the last step and of the one before. */
typedef double *history;

/* In memory the points of a coordinate are contiguous. */
static inline void lanes_load(const double *memory, lanes (*x)[M])
{
  for (int i = 0; i < M; i++)
    for (int n = 0; n < GROUPS; n++)
      memcpy(&x[n][i], memory + i * POINTS + n * LANES, sizeof(lanes));
}

static inline void lanes_store(lanes (*x)[M], double *memory)
{
  for (int i = 0; i < M; i++)
    for (int n = 0; n < GROUPS; n++)
      memcpy(memory + i * POINTS + n * LANES, &x[n][i], sizeof(lanes));
}

/* Memory for the values to be stored. */
static inline coordinates *kept(history past, coordinates *own)
{
  (void)past;
  return own;
}

/* Extrapolates the stored values into this step from the last one or from the last two. */
static inline void continue_curve(const step_data *step, const double *past, long long steps, lanes (*x)[M])
{
  const struct predictor_tables_of tables = tables_of(step);
  lanes last[GROUPS][M], before[GROUPS][M];
  lanes_load(past, last);
  lanes_load(past + M * POINTS, before);
  for (int i = 0; i < M; i++)
    for (int n = 0; n < GROUPS; n++)
      x[n][i] = steps == 1 ? apply(tables.alone, n, last, i)
                           : apply(tables.last, n, last, i) + apply(tables.before, n, before, i);
}

static inline void remember_curve(lanes (*x)[M], history past)
{
  memcpy(past + M * POINTS, past, sizeof(double) * M * POINTS);
  lanes_store(x, past);
}

/* Velocities of a straight line. */
static inline int start_velocities(const step_data *step, lanes (*z)[M])
{
  double v[M];
  const int status = NAME(velocity)(step->t, step->q0, step->p0, step->parameters, v, step->scratch);
  for (int n = 0; status == OK && n < GROUPS; n++)
    for (int i = 0; i < M; i++)
      z[n][i] = lanes_of(v[i]);
  return status;
}

#endif
