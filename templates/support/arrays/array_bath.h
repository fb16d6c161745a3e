#include "../run/normals.h"

/* Heat bath of coordinates with constant masses: steps O(h/2) Phi O(h/2), O the exact step of the Ornstein-Uhlenbeck
 * process, p <- E p + (kT m (1 - E^2))^(1/2) xi with E = exp(-R h / (2 m)), as bath.h for matrices. Each thread has
 * its own coordinates. Requires: compute_bath_terms, perform_steps. */

/* Computes the factors of half a step, E - 1 and (kT m (1 - E^2))^(1/2); returns 0 unless they are finite. */
static int prepare_bath(run_memory *run)
{
  const long long n = coordinates_of(&run->data);
  double *decay = run->bath, *strength = run->bath + n, last = 0.0, loss = 0.0, noise = 0.0;
  memset(run->bath, 0, sizeof(double) * 2 * (size_t)n);
  compute_bath_terms(&run->data, decay, strength);
  for (long long i = 0; i < n; i++) {
    const double exponent = -0.5 * fabs(run->h) * decay[i] * run->inverse_mass[i];
    if (exponent != last) /* else of the coordinate before */
      loss = expm1(exponent), noise = -expm1(2.0 * exponent), last = exponent;
    decay[i] = loss, strength[i] = sqrt(strength[i] * noise);
  }
  return all_finite(run->bath, (int)(2 * n));
}

/* Half a step of the bath; `second`: the one after the step, with the other normals of each pair. */
static void half_of_bath(run_memory *run, long long n, int second)
{
  const double *decay = run->bath, *strength = run->bath + n;
  double first[NORMALS_AT_ONCE], *later = run->bath + 2 * n;
  double *restrict p = run->p, *restrict carry = run->carry_p;
  const double *inverse_mass = run->inverse_mass;
  sums heat;
  wait_at_barrier(run);
  begin_sums(&heat, run, n);
  while (next_block(&heat)) {
    double taken[NORMALS_AT_ONCE] = {0.0};
    for (long long from = heat.here.first, count; from < heat.here.end; from += count) {
      const double *xi = second ? later + from : first;
      count = heat.here.end - from < NORMALS_AT_ONCE ? heat.here.end - from : NORMALS_AT_ONCE;
      if (!second)
        normals(run->seed, (uint64_t)run->step, 1, HEAT, (int)from, (int)count, (uint32_t)run->trajectory, 1, first,
            later + from);
      for (long long j = 0; j < count; j++) {
        const double p0 = p[from + j] + carry[from + j], change = fma(decay[from + j], p0, strength[from + j] * xi[j]);
        taken[j] += change * (p0 + 0.5 * change) * inverse_mass[from + j];
        p[from + j] = p0 + change, carry[from + j] = 0.0;
      }
    }
    for (int half = NORMALS_AT_ONCE / 2; half > 0; half /= 2)
      for (int j = 0; j < half; j++)
        taken[j] += taken[half + j];
    add_block(&heat, taken[0], 0.0);
  }
  wait_at_barrier(run);
  add_compensated(&run->heat, &run->heat_low, sum_of(&heat, 0), 0.0);
}

/* Performs `most` steps in the bath; after a failure the state is that before the step that failed. */
static int perform_in_bath(run_memory *run, const problem *arrays, const work_arrays *work,
    const solver_options *options, solver_report *report, long long most)
{
  const long long n = coordinates_of(arrays);
  const section own = mine(run, n);
  const size_t size = sizeof(double) * (size_t)(own.end - own.first);
  double *before = run->bath + 3 * n + own.first;
  int status = OK;
  for (long long k = 0; k < most && status == OK; k++) {
    const double heat = run->heat, heat_low = run->heat_low;
    memcpy(before, run->p + own.first, size);
    memcpy(before + n, run->carry_p + own.first, size);
    half_of_bath(run, n, 0);
#ifndef TOGETHER
    run->guess = 0; /* velocities are not those of the last step */
#endif
    status = perform_steps(run, arrays, work, options, report, 1);
    if (status == OK)
      half_of_bath(run, n, 1);
    else {
      memcpy(run->p + own.first, before, size);
      memcpy(run->carry_p + own.first, before + n, size);
      run->heat = heat, run->heat_low = heat_low;
    }
  }
  return status;
}
