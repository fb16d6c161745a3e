/* Explicit splitting method in pairs: for every n
 *   p += h KICK[n] F(q, t + h KICK_ABSCISSA[n]),      q += h DRIFT[n] M^-1 p,
 * with constant masses. The step is symplectic for any coefficients, so that two words of them suffice. Of many
 * trajectories, which are SIMD lanes, if LANES is defined. Requires: LEAPS, the tables with their low words, the
 * kernels force_pairs and mass_pairs; and step.h, status_codes.h, or trajectories.h. */
#ifdef LANES
typedef ddl pair;
#define OF_PAIRS(name) ddl_##name
#define PAIR_OF(x) ddl_of(x)
#define PAIR_OF_WORDS ddl_of_words
#else
typedef dd pair;
typedef double number;
#define OF_PAIRS(name) dd_##name
#define PAIR_OF(x) (x)
#define PAIR_OF_WORDS dd_of
#endif

static inline void invert_mass_pairs(double time, const number *parameters, pair *inverse_mass)
{
  mass_pairs(NULL, dd_of(time, 0.0), parameters, inverse_mass);
  for (int i = 0; i < M; i++)
    inverse_mass[i] = OF_PAIRS(divide)(PAIR_OF(dd_of(1.0, 0.0)), inverse_mass[i]);
}

#include "../iteration/leap.h"

#ifdef LANES
typedef struct {
  pair inverse_mass[M];
} iteration_data;

static void prepare_iteration(const step_data *step, iteration_data *data)
{
  invert_mass_pairs(step->t, step->parameters, data->inverse_mass);
}

/* Computes the increments of one step of each trajectory. The last step has stored its last force, high words and low
 * words as values at two points. */
static inline void fixed_point(const step_data *step, const iteration_data *data, history past, long long *guess,
    lanes *dq, lanes *dp, const solver_options *options, solver_report *report)
{
  pair F[M];
  for (int i = 0; i < M; i++)
    F[i] = ddl_of_words(past.last[0][i], past.last[1][i]);
  leap_in_pairs(
      step, dd_of(step->t, step->t_low), dd_of(step->h, step->h_low), data->inverse_mass, *guess > 0, F, dq, dp);
  for (int i = 0; i < M; i++)
    past.before[0][i] = F[i].high, past.before[1][i] = F[i].low;
  report->iterations++;
  *guess = 1;
}
#else
typedef int solver_data; /* not used */

#define prepare(step, data) (void)(*(data) = 0)

/* Solves nothing: refine_increments, which has both words of t and h, computes the step. The last number of the memory
 * is 1 if it contains the inverse masses and the last force, which the next step reuses if it starts with a kick. */
static int solve(const step_data *step, const solver_data *data, double *memory, long long *guess, double *dq,
    double *dp, const solver_options *options, solver_report *report, double *workspace)
{
  memset(dq, 0, sizeof(double) * 2 * M);
  memset(dp, 0, sizeof(double) * 2 * M);
  memory[MEMORY - 1] = *guess > 0;
  report->iterations++;
  *guess = 1;
  return OK;
}

HOT int refine_increments(const step_data *step, double *memory, double t_low, double h_low, double *dq, double *dp,
    double *passed, double *workspace)
{
  pair kept[2][M]; /* inverse masses, last force */
  const int known = memory[MEMORY - 1] > 0.0;
  memcpy(kept, memory, sizeof kept);
  if (!known)
    invert_mass_pairs(step->t, step->parameters, kept[0]);
  leap_in_pairs(step, dd_of(step->t, t_low), dd_of(step->h, h_low), kept[0], known, kept[1], dq, dp);
  TRY(reaches(step, dq, dp) ? OK : NOT_FINITE);
  memcpy(memory, kept, sizeof kept);
  return OK;
}
#endif
