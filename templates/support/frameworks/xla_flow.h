#include "flow.h"

/* Flow as XLA custom calls through the XLA FFI. */
#include <stdio.h>

#include "xla/ffi/api/c_api.h"

/* Returns 1 if XLA only asks for the version of the interface that the handler was compiled for; sets it. */
static int answers_version(const XLA_FFI_CallFrame *frame)
{
  for (XLA_FFI_Extension_Base *each = frame->extension_start; each; each = each->next)
    if (each->type == XLA_FFI_Extension_Metadata) {
      XLA_FFI_Metadata *asked = ((XLA_FFI_Metadata_Extension *)each)->metadata;
      asked->api_version.major_version = XLA_FFI_API_MAJOR;
      asked->api_version.minor_version = XLA_FFI_API_MINOR;
      asked->traits = 0;
      return 1;
    }
  return 0;
}

static XLA_FFI_Error *failure(const XLA_FFI_CallFrame *frame, int status, const solver_report *report)
{
  static const char *const reasons[] = {"the iteration on the stage equations did not converge",
      "the Newton matrix is singular", "a value is infinite or NaN", "the step size is below machine precision",
      "the iteration converged to a spurious solution of the stage equations",
      "there is not enough memory for Newton's method"};
  char text[200];
  XLA_FFI_Error_Create_Args error = {XLA_FFI_Error_Create_Args_STRUCT_SIZE, NULL, text, XLA_FFI_Error_Code_ABORTED};
  snprintf(text, sizeof text, "step %lld at t = %.17g failed: %s", report->steps, report->t, reasons[status - 1]);
  return frame->api->XLA_FFI_Error_Create(&error);
}

/* Numbers of steps, and of steps between stored states, from the attributes, which are sorted by name; `count`
 * vectors. */
static flow_call way_of(const XLA_FFI_CallFrame *frame, int count)
{
  const long long *every = ((XLA_FFI_Scalar *)frame->attrs.attrs[0])->value;
  const long long *steps = ((XLA_FFI_Scalar *)frame->attrs.attrs[1])->value;
  return (flow_call){.steps = *steps, .every = *every, .count = count};
}

static long long rows_of(const XLA_FFI_Buffer *x)
{
  long long rows = 1;
  for (long long i = 0; i + 1 < x->rank; i++)
    rows *= x->dims[i];
  return rows;
}

/* Evaluates the flow: x (.., STEP_INPUTS), for derivatives also vectors (.., count, size), for second ones tangent
 * vectors behind them. */
static XLA_FFI_Error *flow_of_frame(flow_part part, XLA_FFI_CallFrame *frame)
{
  if (answers_version(frame))
    return NULL;
  const XLA_FFI_Buffer *x = frame->args.args[0], *given = part == FLOW_STATES ? x : frame->args.args[1];
  const XLA_FFI_Buffer *changes = part == FLOW_HESSIAN ? frame->args.args[2] : x, *found = frame->rets.rets[0];
  flow_call way = way_of(frame, part == FLOW_STATES ? 0 : (int)given->dims[x->rank - 1]);
  solver_report report;
  const int status = flow_rows(part, &way, rows_of(x), x->data, given->data, changes->data, found->data, &report);
  return status == OK ? NULL : failure(frame, status, &report);
}

XLA_FFI_Error *NAME(xla_states)(XLA_FFI_CallFrame *frame)
{
  return flow_of_frame(FLOW_STATES, frame);
}

XLA_FFI_Error *NAME(xla_jvp)(XLA_FFI_CallFrame *frame)
{
  return flow_of_frame(FLOW_JVP, frame);
}

XLA_FFI_Error *NAME(xla_vjp)(XLA_FFI_CallFrame *frame)
{
  return flow_of_frame(FLOW_VJP, frame);
}

#ifdef SECOND_DERIVATIVES
/* Derivatives of gradients. */
XLA_FFI_Error *NAME(xla_vjp_derivative)(XLA_FFI_CallFrame *frame)
{
  return flow_of_frame(FLOW_HESSIAN, frame);
}
#endif
