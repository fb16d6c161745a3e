#include "../core/step.h"

/* Inputs: piecewise polynomials of time. A run ends a step at their breakpoints and continues with the parameters of
 * the next pieces. Requires: step.h, and INPUT_INDEX, the indices of the parameters of each input. */

#define NO_STEP (sizeof(real) < sizeof(double) ? 1e-3 : 1e-9) /* relative to a step: a shorter remaining interval needs
                                                               * no step */

typedef NAME(input) input_data;

/* Index of the piece that contains t; the search begins at the last one. */
static int piece_at(const input_data *input, real t)
{
  int k = input->piece;
  while (k + 1 < input->pieces && input->t[k + 1] <= t)
    k++;
  while (k > 0 && input->t[k] > t)
    k--;
  return k;
}

/* First breakpoint of an input between t and end that is farther than slack; end if there is none. */
static real breakpoint_before(const input_data *input, real t, real end, real slack)
{
  const int way = end < t ? -1 : 1;
  int k = input->piece + (way < 0);
  while (k >= 0 && k <= input->pieces && (real)way * (input->t[k] - t) <= slack)
    k += way;
  return k >= 0 && k <= input->pieces && (real)way * (end - input->t[k]) > 0 ? input->t[k] : end;
}

real NAME(next_breakpoint)(const run_memory *run, real t_end, real h, input_data *inputs, real *parameters)
{
  const real slack = (real)NO_STEP * MATH(fmin)(MATH(fabs)(h), MATH(fabs)(t_end - run->t));
  real end = t_end;
  for (int i = 0; i < INPUTS; i++) {
    inputs[i].piece = piece_at(inputs + i, run->t);
    end = breakpoint_before(inputs + i, run->t, end, slack);
  }
  for (int i = 0; i < INPUTS; i++) {
    real *own = parameters + INPUT_INDEX[i];
    const int k = piece_at(inputs + i, run->t + (end - run->t) / 2);
    inputs[i].piece = k;
    memcpy(own, inputs[i].coefficients + 4 * k, 4 * sizeof(real));
    own[4] = inputs[i].t[k];
  }
  return end;
}

long long NAME(next_steps)(run_memory *run, real t_end, real h, input_data *inputs, real *parameters)
{
  const real left = NAME(next_breakpoint)(run, t_end, h, inputs, parameters) - run->t - run->t_low;
  const real whole = MATH(floor)(left / h + (real)NO_STEP), length = whole >= 1 ? h : left;
  const real shorter = run->step > 0 ? MATH(fmin)(MATH(fabs)(h), MATH(fabs)(run->h)) : 0;
  if (!(left / h > 0) || MATH(fabs)(left) <= (real)NO_STEP * shorter)
    return 0;
  run->guess = run->h == length ? run->guess : 0;
  run->h = length;
  return whole >= 1 ? (long long)whole : 1;
}
