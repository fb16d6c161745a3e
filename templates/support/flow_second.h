/* Second derivatives of a flow: tangent vectors of its VJP. Requires: flow.h, second_derivatives.h. */

/* Computes from (count, kept states, FLOW_STATE) adjoint vectors, each with one of (count, STEP_INPUTS) tangent
 * vectors of the inputs, the (count, STEP_INPUTS) derivatives of the gradients along them. `room` is for (steps + 1,
 * count, STEP_INPUTS) tangent vectors and (FLOW_CHUNK + 1, 2, count, STEP_INPUTS) adjoint vectors with their
 * derivatives. */
static int hessian_along(const flow_call *way, const real *x, const real *kept, const real *changes, real *found,
    real *room, solver_report *report)
{
  const long long across = (long long)way->count * STEP_INPUTS;
  real *partials = room + (way->steps + 1) * across;
  int status = OK, length = 0;
  memset(room, 0, sizeof(real) * (size_t)((way->steps + 1 + 2 * (FLOW_CHUNK + 1)) * across));
  memcpy(room, changes, sizeof(real) * (size_t)across);
  for (long long done = 0; done < way->steps && status == OK; done += length) {
    flow_call here = *way;
    here.vectors = room + done * across;
    length = chunk_size_after(way, done);
    status = propagate_chunk_of_steps(&here, x, done, length, 0, report);
  }
  for (long long end = way->steps; end > 0 && status == OK; end -= length) {
    length = chunk_size_after(way, way->steps - end);
    memcpy(partials + 2 * length * across, partials, sizeof(real) * (size_t)(2 * across));
    memset(partials, 0, sizeof(real) * (size_t)(2 * across * length));
    for (int k = 1; k <= length; k++)
      add_adjoints(way, end - length + k, kept, partials + 2 * k * across);
    fill_chunk(way, x, end - length, length);
    status = NAME(second_order)(length, way->t, way->h, way->q, way->p, x + FLOW_STATE, NULL, way->count,
        room + (end - length) * across, partials, report, way->workspace);
    if (status != OK)
      report->steps = end - 1 - report->steps;
  }
  memcpy(found, partials + across, sizeof(real) * (size_t)across);
  return status;
}

/* hessian_along for each of `rows` rows x of STEP_INPUTS inputs. */
static int hessian_rows(flow_call *way, long long rows, const real *x, const real *partials, const real *changes,
    real *found, solver_report *report)
{
  const long long across = (long long)way->count * STEP_INPUTS, values = way->count * kept_states(way) * FLOW_STATE;
  real *room = malloc(sizeof(real) * (size_t)((way->steps + 1 + 2 * (FLOW_CHUNK + 1)) * across));
  int status = OK, made = allocate_flow(way);
  memset(report, 0, sizeof *report);
  if (!made || !room)
    status = FLOW_NO_MEMORY;
  for (long long row = 0; row < rows && status == OK; row++, x += STEP_INPUTS) {
    status = follow(way, x, 1, way->states, report);
    if (status == OK)
      status = hessian_along(way, x, partials + row * values, changes + row * across, found + row * across, room,
          report);
  }
  free(way->workspace);
  free(room);
  return status;
}
