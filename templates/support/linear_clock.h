/* Linearised time of a time-transformed system: time is an integral along the curve, by the weights of the first
 * points. Requires: linearised.h, INTEGRAL_WEIGHT, RATE_ENTRY, RATE_DERIVATIVES, the kernels rate_derivatives and
 * energy_derivatives. */

/* Derivative of the time at the end with respect to that at the start, q0, parameters, h and the unknowns; back: its
 * transpose. */
static void end_time(const linearised_step *at, int back)
{
  const step_data *step = at->step;
  const stage_group *f = STAGE_GROUPS;
  wide *time = at->v + INPUT_H - 1, *u = at->points;
  real *place = step->scratch;
  memset(u, 0, sizeof(wide) * (size_t)(f->points * f->arguments));
  if (!back)
    arguments_wide(f, step->h, back, at->partials, at->v, at->dz, u);
  arguments_of(f, step, at->data.z, place);
  for (int n = 0; n < f->points; n++) {
    const real weight = INTEGRAL_WEIGHT[n];
    real rate, derivative[RATE_DERIVATIVES];
    rate_derivatives(place + n * f->arguments, step->t, step->parameters, &rate, derivative);
    for (int e = 0; e < RATE_DERIVATIVES; e++) {
      const int j = RATE_ENTRY[e];
      flow(back, time, step->h * weight * derivative[e],
          j < f->arguments ? u + n * f->arguments + j : at->v + 2 * M + j - f->arguments);
    }
    flow(back, time, weight * rate, at->v + INPUT_H);
  }
  if (back)
    arguments_wide(f, step->h, back, at->partials, at->v, at->dz, u);
}

int NAME(energy_gradient)(const real *q, const real *p, const real *parameters, real *partials, real *workspace)
{
  real u[2 * M];
  int status = OK;
  memcpy(u, q, sizeof(real) * M);
#ifdef FROM_MOMENTA
  memcpy(u + M, p, sizeof(real) * M);
  (void)workspace;
#else
  status = NAME(velocity)(0, q, p, parameters, u + M, workspace);
#endif
  if (status == OK)
    energy_derivatives(u, 0, parameters, partials);
  return status == OK && !all_finite(partials, STEP_INPUTS - 2) ? NOT_FINITE : status;
}
