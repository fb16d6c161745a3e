#include "bath.h"

/* Half steps of the bath of many trajectories, which are SIMD lanes; trajectory k has stream k of the noise, as in
 * single runs (bath_run.h). Requires: ensemble_run.h, bath.h. */

/* Factors and normals of half steps of the trajectories of a block, their states before a step and after its first half
 * in the bath. */
typedef struct {
  present_factors factors;
  lanes first[STEPS_DRAWN][DRAWN], second[STEPS_DRAWN][DRAWN];
  state before, heated;
} block_bath;

/* State and parameters of a lane. */
static void read_lane(const block_memory *block, const state *now, int j, double *q, double *p, double *parameters)
{
  for (int i = 0; i < M; i++)
    q[i] = now->q[i][j], p[i] = now->p[i][j];
  for (int i = 0; i < P; i++)
    parameters[i] = block->parameters[i][j];
}

/* Computes the factors at present positions; deactivates the lanes without any. */
static void prepare_lanes(block_bath *bath, block_memory *block, const state *now)
{
  double *factors = (double *)&bath->factors;
  for (int j = 0; j < LANES; j++) {
    bath_factors own;
    double q[M], p[M], parameters[P + 1];
    read_lane(block, now, j, q, p, parameters);
    if (!prepare_bath(&own, block->t, block->h, q, parameters))
      block->active[j] = 0;
    for (size_t i = 0; i < sizeof own / sizeof(double); i++)
      factors[i * LANES + j] = ((const double *)&own)[i];
  }
}

/* Iterations start from the straight line, as in single runs; its velocities are stored if theirs are. */
static void forget_curve(block_memory *block, const state *now, lanes (*memory)[M])
{
#ifndef SPLITTING
  block->guess = 0;
#endif
#ifdef LINE_VELOCITIES
  for (int j = 0; j < LANES; j++) {
    double q[M], p[M], v[M], parameters[P + 1], scratch[SCRATCH];
    read_lane(block, now, j, q, p, parameters);
    if (find_velocity(block->t, q, p, parameters, v, scratch) != OK)
      block->active[j] = 0;
    for (int n = 0; n < 2 * STORED * M && block->active[j] > 0; n++)
      memory[n / M][n % M][j] = v[n % M];
  }
#endif
}

/* Replaces the states of lanes where `stays` is 0. */
static inline void select_states(lanes stays, state *now, const state *others)
{
  for (size_t i = 0; i < sizeof *now / sizeof(lanes); i++)
    ((lanes *)now)[i] = lanes_selected(stays, ((lanes *)now)[i], ((const lanes *)others)[i]);
}

/* Phi_-h is Phi_h of reversed momenta, bit by bit, if L is even in velocities. */
static inline void reverse_momenta(const block_memory *block, state *now)
{
  for (int j = 0; j < LANES; j++)
    for (int i = 0; i < M && block->reversed[j] > 0.0; i++)
      now->p[i][j] = -now->p[i][j], now->carry_p[i][j] = -now->carry_p[i][j];
}

/* Accepts or rejects the step of each lane, as is_accepted; or deactivates lanes in which many iterations change the
 * energy by more than kT: single runs decide (status_of_root). */
static void judge_step(const block_bath *bath, block_memory *block, double t, state *now)
{
  double chance[LANES];
  lane_view stays = {lanes_of(1.0)};
  uniform_numbers(block->seed, (uint64_t)block->step - 1, ACCEPTANCE, (uint32_t)block->trajectory, LANES, chance);
  for (int j = 0; j < LANES; j++) {
    double q[M], p[M], parameters[P + 1], energy[2] = {NAN, NAN}, scratch[SCRATCH], kT = bath->factors.terms[0][j];
    for (int k = 0; k < 2; k++) {
      read_lane(block, k ? now : &bath->heated, j, q, p, parameters);
      NAME(energy)(t, q, p, parameters, &energy[k], scratch);
    }
    if (!block->metropolis)
      block->active[j] = kT == 0 || fabs(energy[1] - energy[0]) <= kT ? block->active[j] : 0.0;
    else if (!(log(chance[j]) <= -(energy[1] - energy[0]) / kT))
      stays.lane[j] = 0.0, block->reversed[j] = 1.0 - block->reversed[j];
  }
  select_states(stays.all, now, &bath->heated);
  block->guess = 0;
}

/* The half before step k of a call. */
static inline void enter_step(block_bath *bath, block_memory *block, long long k, state *now, lanes (*memory)[M])
{
  bath->before = *now;
  if (k % STEPS_DRAWN == 0)
    normals(block->seed, (uint64_t)block->step, STEPS_DRAWN, HEAT, 0, DRAWN, (uint32_t)block->trajectory, LANES,
        (double *)bath->first, (double *)bath->second);
  exchange_heat(&bath->factors, bath->first[k % STEPS_DRAWN], now->p, now->carry_p);
#ifdef SPLITTING
  if (block->metropolis)
#endif
    bath->heated = *now;
  if (block->metropolis)
    reverse_momenta(block, now);
  forget_curve(block, now, memory);
}

/* The half after it, of so many iterations; lanes that failed return to the state before both. */
static inline void leave_step(block_bath *bath, block_memory *block, long long k, double t, long long iterations,
    state *now)
{
  lane_view active;
  if (block->metropolis)
    reverse_momenta(block, now);
  if (block->metropolis || iterations > FEW_ITERATIONS)
    judge_step(bath, block, t, now);
#ifndef CONSTANT_BATH
  prepare_lanes(bath, block, now);
#endif
  exchange_heat(&bath->factors, bath->second[k % STEPS_DRAWN], now->p, now->carry_p);
  memcpy(&active, block->active, sizeof active);
  select_states(active.all, now, &bath->before);
}
