/* Uniform damping at points that are SIMD lanes, or of trajectories that are; see damping.h. Requires: points.h or
 * trajectories.h, the table ABSCISSA, the kernel damping. */
#define DAMPED

/* Constants of a step size: e^(gamma c_n h), the factor of L_q and L_v at the points; e^(-gamma h), and e^(-gamma h) -
 * 1. */
typedef struct {
  lanes grown[GROUPS];
  number shrunk, loss;
} damping_data;

static void prepare_damping(const step_data *step, damping_data *data)
{
  number rate[1], growth;
  damping(NULL, step->t, step->parameters, rate);
  growth = step->h * rate[0];
  for (int n = 0; n < GROUPS; n++) {
    lane_view view = {lanes_of_number(growth) * ABSCISSA[n]};
    for (int j = 0; j < LANES; j++)
      view.lane[j] = exp(view.lane[j]);
    data->grown[n] = view.all;
  }
  data->shrunk = exponential(-growth);
  data->loss = exponential_less_1(-growth);
}

static inline void grow(const damping_data *data, int n, int count, lanes *x)
{
  for (int i = 0; i < count; i++)
    x[i] *= data->grown[n];
}
