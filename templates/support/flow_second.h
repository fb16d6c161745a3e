/* Second derivatives of a flow: tangent vectors of its VJP. Requires: flow.h, second_derivatives.h. */

/* Computes from (count, kept states, FLOW_STATE) adjoint vectors, each with one of (count, GIVEN) tangent vectors of
 * the inputs, the (count, GIVEN) derivatives of the gradients along them. `room` is for (steps + 1, count, GIVEN)
 * tangent vectors and (FLOW_PIECE + 1, 2, count, GIVEN) adjoint vectors with their derivatives. */
static int bend_along(const flow_way *way, const real *x, const real *kept, const real *changes, real *found,
    real *room, solver_report *report)
{
  const long long across = (long long)way->count * GIVEN;
  real *slopes = room + (way->steps + 1) * across;
  int status = OK, length = 0;
  memset(room, 0, sizeof(real) * (size_t)((way->steps + 1 + 2 * (FLOW_PIECE + 1)) * across));
  memcpy(room, changes, sizeof(real) * (size_t)across);
  for (long long done = 0; done < way->steps && status == OK; done += length) {
    flow_way here = *way;
    here.vectors = room + done * across;
    length = piece_after(way, done);
    status = carry_piece(&here, x, done, length, 0, report);
  }
  for (long long end = way->steps; end > 0 && status == OK; end -= length) {
    length = piece_after(way, way->steps - end);
    memcpy(slopes + 2 * length * across, slopes, sizeof(real) * (size_t)(2 * across));
    memset(slopes, 0, sizeof(real) * (size_t)(2 * across * length));
    for (int k = 1; k <= length; k++)
      add_slopes(way, end - length + k, kept, slopes + 2 * k * across);
    place_piece(way, x, end - length, length);
    status = NAME(bend)(length, way->t, way->h, way->q, way->p, x + FLOW_STATE, NULL, way->count,
        room + (end - length) * across, slopes, report, way->workspace);
    if (status != OK)
      report->steps = end - 1 - report->steps;
  }
  memcpy(found, slopes + across, sizeof(real) * (size_t)across);
  return status;
}

/* bend_along for each of `rows` rows x of GIVEN inputs. */
static int bend_rows(flow_way *way, long long rows, const real *x, const real *slopes, const real *changes,
    real *found, solver_report *report)
{
  const long long across = (long long)way->count * GIVEN, values = way->count * kept_states(way) * FLOW_STATE;
  real *room = malloc(sizeof(real) * (size_t)((way->steps + 1 + 2 * (FLOW_PIECE + 1)) * across));
  int status = OK, made = make_way(way);
  memset(report, 0, sizeof *report);
  if (!made || !room)
    status = FLOW_NO_MEMORY;
  for (long long row = 0; row < rows && status == OK; row++, x += GIVEN) {
    status = follow(way, x, 1, way->states, report);
    if (status == OK)
      status = bend_along(way, x, slopes + row * values, changes + row * across, found + row * across, room, report);
  }
  free(way->workspace);
  free(room);
  return status;
}
