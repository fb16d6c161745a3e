/* Momenta at both ends of a curve by quadrature of the action; p0 determines the initial velocity. Requires:
 * curve_points.h, the tables of the contributions of the points to p0 and p1, the kernel action_lanes. */
typedef struct {
  lanes start, end; /* h times the weights of forces */
} iteration_data;

static void prepare_iteration(const step_data *step, iteration_data *data)
{
  data->start = step->h * START_FORCE;
  data->end = step->h * END_FORCE;
}

/* Forces and momenta at the points. */
static inline void act(const step_data *step, const curve_data *curve, lanes *action)
{
  lanes u[2 * M];
  place_points(step, curve, u);
  action_lanes(u, step->t + step->h * POINT_TIME, step->parameters, action);
}

/* Corrects the initial velocity; returns the squared relative change. */
static inline double correct_start(const step_data *step, const iteration_data *data, const lanes *mass,
    const double *inverse_size, curve_data *curve)
{
  lanes action[2 * M];
  double misfit[M];
  act(step, curve, action);
  for (int i = 0; i < M; i++)
    misfit[i] =
        -(step->p0[i] + (step->carry_p[i] + lanes_total(data->start * action[i] + START_MOMENTUM * action[M + i])));
  return correct_velocity(mass, misfit, inverse_size, curve->v0);
}

/* p1 - p0 of a curve. */
static inline void momentum_increment(const step_data *step, const iteration_data *data, const curve_data *curve,
    const double *dq, double *dp)
{
  lanes action[2 * M];
  (void)dq;
  act(step, curve, action);
  for (int i = 0; i < M; i++)
    dp[i] = lanes_total(data->end * action[i] + END_MOMENTUM * action[M + i]);
}
