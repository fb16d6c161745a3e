/* Uniform damping at points that are lanes, or of trajectories that are: see damping.h. Before it: points.h or
 * trajectories.h, the table ABSCISSA, the kernel damping. */
#define DAMPED

/* What the steps of a run share: e^(gamma c_n h), by which L_q, L_v and L_vv grow at the points; e^(-gamma h), and it
 * less 1. */
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
