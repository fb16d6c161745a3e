/* Functions of the state observed at the ends of all steps, lane by lane. Requires: ensemble_run.h, and the kernel
 * observed_lanes, OBSERVED values at u = (q, p). */

/* Last, least and largest values, or with COUNTS_SIGNS numbers of rises from negative values and of falls from positive
 * ones. NaN is included in none of them; including a state twice changes nothing. */
typedef struct {
  lanes last[OBSERVED], least[OBSERVED], largest[OBSERVED], rises[OBSERVED], falls[OBSERVED];
} observation;

static void observe(observation *seen, const state *now, double t, const lanes *parameters, const double *active)
{
  lanes u[2 * M], values[OBSERVED];
  for (int i = 0; i < M; i++) {
    u[i] = now->q[i];
    u[M + i] = now->p[i];
  }
  observed_lanes(u, t, parameters, values);
  for (int i = 0; i < OBSERVED; i++) {
    const lane_view value = {values[i]}, before = {seen->last[i]};
    lane_view last = before;
#ifdef COUNTS_SIGNS
    lane_view rises = {seen->rises[i]}, falls = {seen->falls[i]};
#else
    lane_view least = {seen->least[i]}, largest = {seen->largest[i]};
#endif
    for (int j = 0; j < LANES; j++) {
      const double x = active[j] > 0.0 ? value.lane[j] : before.lane[j];
      last.lane[j] = x;
#ifdef COUNTS_SIGNS
      rises.lane[j] += before.lane[j] < 0.0 && x >= 0.0 ? 1.0 : 0.0;
      falls.lane[j] += before.lane[j] > 0.0 && x <= 0.0 ? 1.0 : 0.0;
#else
      least.lane[j] = x >= least.lane[j] ? least.lane[j] : x;
      largest.lane[j] = x <= largest.lane[j] ? largest.lane[j] : x;
#endif
    }
    seen->last[i] = last.all;
#ifdef COUNTS_SIGNS
    seen->rises[i] = rises.all;
    seen->falls[i] = falls.all;
#else
    seen->least[i] = least.all;
    seen->largest[i] = largest.all;
#endif
  }
}
