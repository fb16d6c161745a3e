#include "bath.h"

/* Half steps of the bath of many trajectories, which are SIMD lanes; trajectory k has stream k of the noise, as in
 * single runs (bath_run.h). Requires: ensemble_run.h, bath.h. */
enum {
  DRAWN = M + STRENGTHS, /* normals of a half step */
  STEPS_DRAWN = DRAWN * LANES < NORMALS_AT_ONCE ? NORMALS_AT_ONCE / (DRAWN * LANES) : 1 /* at once */
};

/* Factors and normals of half steps of the trajectories of a block, and their states before a step. */
typedef struct {
  present_factors factors;
  lanes first[STEPS_DRAWN][DRAWN], second[STEPS_DRAWN][DRAWN];
  state before;
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
  (void)now, (void)memory;
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

/* The half before step k of a call. */
static inline void enter_step(block_bath *bath, block_memory *block, long long k, state *now, lanes (*memory)[M])
{
  bath->before = *now;
  if (k % STEPS_DRAWN == 0)
    normals(block->seed, (uint64_t)block->step, STEPS_DRAWN, HEAT, 0, DRAWN, (uint32_t)block->trajectory, LANES,
        (double *)bath->first, (double *)bath->second);
  exchange_heat(&bath->factors, bath->first[k % STEPS_DRAWN], now->p, now->carry_p);
  forget_curve(block, now, memory);
}

/* The half after it; lanes that failed return to the state before both. */
static inline void leave_step(block_bath *bath, block_memory *block, long long k, state *now)
{
  lanes *states = (lanes *)now;
  const lanes *before = (const lanes *)&bath->before;
  lane_view active;
#ifndef CONSTANT_BATH
  prepare_lanes(bath, block, now);
#endif
  exchange_heat(&bath->factors, bath->second[k % STEPS_DRAWN], now->p, now->carry_p);
  memcpy(&active, block->active, sizeof active);
  for (size_t i = 0; i < sizeof *now / sizeof(lanes); i++)
    states[i] = lanes_selected(active.all, states[i], before[i]);
}
