/* Derivatives of gradients as an XLA custom call. Requires: xla_flow.h, flow_second.h. */

/* x (.., STEP_INPUTS), adjoint vectors (.., count, kept states, FLOW_STATE) and tangent vectors (.., count,
 * STEP_INPUTS); results like the latter. */
XLA_FFI_Error *NAME(xla_vjp_derivative)(XLA_FFI_CallFrame *frame)
{
  flow_call way;
  solver_report report;
  const XLA_FFI_Buffer *x, *partials, *changes, *found;
  int status;
  if (answers_version(frame))
    return NULL;
  x = frame->args.args[0];
  partials = frame->args.args[1];
  changes = frame->args.args[2];
  found = frame->rets.rets[0];
  way = way_of(frame, (int)partials->dims[x->rank - 1]);
  status = hessian_rows(&way, rows_of(x), x->data, partials->data, changes->data, found->data, &report);
  return status == OK ? NULL : failure(frame, status, &report);
}
