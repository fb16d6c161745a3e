/* Instances of an FMU and their modes (FMI 3.0, co-simulation). Requires: the integrator's header, the FMI header, and
 * NAME, STATUS, WORKSPACE, TOKEN, STEP, M, PARAMETERS, BY_VELOCITY, and the start values. */

#ifdef __GNUC__
#pragma GCC diagnostic ignored "-Wunused-parameter" /* the standard has more of them than this FMU */
#endif
enum { LONGEST_MESSAGE = 240 };

typedef NAME(run) run_memory;
typedef NAME(report) run_report;
#ifdef EVENT_SETTINGS
typedef NAME(watch) event_watch;
typedef NAME(crossing) event_crossing;
#endif

/* Value references: t, positions, velocities, momenta, energy, parameters. */
enum {
  TIME = 0,
  POSITIONS = 1,
  VELOCITIES = POSITIONS + M,
  MOMENTA = VELOCITIES + M,
  ENERGY = MOMENTA + M,
  FIRST_PARAMETER = ENERGY + 1,
  REFERENCES = FIRST_PARAMETER + PARAMETERS,
  MOVING = BY_VELOCITY ? VELOCITIES : MOMENTA /* the initial values that can be set */
};

typedef enum {
  INSTANTIATED,
  INITIALIZATION_MODE,
  STEP_MODE,
  EVENT_MODE,
  TERMINATED
} fmu_mode;

/* The complete state of an instance: a copy restores it bit for bit. */
typedef struct {
  char token[sizeof TOKEN]; /* of the FMU that the state belongs to */
  fmu_mode mode;
  bool behind; /* 1 if dependent values are out of date */
  double values[REFERENCES];
#ifdef EVENT_SETTINGS
  event_watch watch;
  bool pending; /* 1 if the values are those before a change of the run's state */
  double whole; /* end of the step that the last event cut */
#endif
  run_memory run;
} fmu_state;

#ifdef EVENT_SETTINGS
enum { MOST_CHANGES = 256 };

/* States and crossings of a call. */
typedef struct {
  double t[MOST_CHANGES], q[MOST_CHANGES * M], p[MOST_CHANGES * M], length[MOST_CHANGES];
  int iterations[MOST_CHANGES];
  long long number[MOST_CHANGES];
  long long filled;
  event_crossing found[MOST_CHANGES];
} event_memory;
#endif

typedef struct {
  fmu_state now, before; /* before: at the last communication point, to restore after a failure */
  fmi3InstanceEnvironment environment;
  fmi3LogMessageCallback log;
  bool logs_discards, has_event_mode, returns_early;
#ifdef EVENT_SETTINGS
  event_memory memory;
#endif
  double workspace[WORKSPACE];
} fmu;

/* Logs the reason of a failed call if there is a logger; returns `status`. */
static fmi3Status failed(const fmu *one, fmi3Status status, const char *format, ...)
{
  char message[LONGEST_MESSAGE];
  va_list arguments;
  if (!one || !one->log || (status == fmi3Discard && !one->logs_discards))
    return status;
  va_start(arguments, format);
  vsnprintf(message, sizeof message, format, arguments);
  va_end(arguments);
  one->log(one->environment, status, status == fmi3Discard ? "logStatusDiscard" : "logStatusError", message);
  return status;
}

static fmi3Status not_now(const fmu *one, const char *call)
{
  return failed(one, fmi3Error, "%s is not allowed in this mode", call);
}

/* Description of a status of the integrator. */
static const char *reason(int status)
{
  static const char *const others[] = {"the iteration on the stage equations did not converge: use a smaller step",
      "the Newton matrix or the mass matrix is singular", "a value is infinite or NaN"};
  return status <= STATUS(NOT_FINITE)
      ? others[status - STATUS(NOT_CONVERGED)]
      : "the iteration converged to a spurious solution of the stage equations: use a smaller step";
}

static void set_start(fmu_state *now)
{
  memset(now, 0, sizeof *now);
  memcpy(now->token, TOKEN, sizeof TOKEN);
#ifdef EVENT_SETTINGS
  now->watch = (event_watch)EVENT_SETTINGS;
#endif
  now->mode = INSTANTIATED;
  now->behind = true;
  now->values[TIME] = START_TIME;
  memcpy(now->values + POSITIONS, START_POSITIONS, sizeof(double) * M);
  memcpy(now->values + MOVING, START_MOVING, sizeof(double) * M);
  memcpy(now->values + FIRST_PARAMETER, START_PARAMETERS, sizeof(double) * PARAMETERS);
}

/* Updates the dependent values: momenta if velocities are given, otherwise velocities; the energy. */
static fmi3Status follow(fmu *one, fmi3Status otherwise)
{
  double *x = one->now.values;
  const double *parameters = x + FIRST_PARAMETER;
  int status;
  if (!one->now.behind)
    return fmi3OK;
  if (BY_VELOCITY && one->now.mode < STEP_MODE)
    status = NAME(momentum)(x[TIME], x + POSITIONS, x + VELOCITIES, parameters, x + MOMENTA, one->workspace);
  else
    status = NAME(velocity)(x[TIME], x + POSITIONS, x + MOMENTA, parameters, x + VELOCITIES, one->workspace);
  if (status == STATUS(OK))
    status = NAME(energy)(x[TIME], x + POSITIONS, x + MOMENTA, parameters, x + ENERGY, one->workspace);
  if (status != STATUS(OK))
    return failed(one, otherwise, "velocities, momenta or energy at t = %g: %s", x[TIME], reason(status));
  one->now.behind = false;
  return fmi3OK;
}

FMI_EXPORT fmi3String FMI(GetVersion)(void)
{
  return "3.0";
}

FMI_EXPORT fmi3Instance FMI(InstantiateCoSimulation)(fmi3String name, fmi3String token, fmi3String resources,
    fmi3Boolean visible, fmi3Boolean logging, fmi3Boolean events, fmi3Boolean early, const fmi3ValueReference *required,
    size_t count, fmi3InstanceEnvironment environment, fmi3LogMessageCallback log, fmi3Callback update)
{
  fmu *one = calloc(1, sizeof *one);
  const char *wrong = NULL;
  bool without_events = true;
#ifdef EVENT_SETTINGS
  without_events = false;
#endif
  if (!one)
    return NULL;
  one->environment = environment;
  one->log = log;
  one->logs_discards = logging;
  one->has_event_mode = events;
  one->returns_early = events && early;
  set_start(&one->now);
  if (!token || strcmp(token, TOKEN) != 0)
    wrong = "the instantiation token belongs to another FMU: use the token of this modelDescription.xml";
  else if (events && without_events)
    wrong = "this FMU has no events, hence no event mode";
  else if (count > 0)
    wrong = "this FMU has no intermediate variables";
  if (!wrong)
    return one;
  failed(one, fmi3Error, "%s", wrong);
  free(one);
  return NULL;
}

FMI_EXPORT void FMI(FreeInstance)(fmi3Instance instance)
{
  free(instance);
}

FMI_EXPORT fmi3Status FMI(SetDebugLogging)(fmi3Instance instance, fmi3Boolean logging, size_t count,
    const fmi3String *categories)
{
  fmu *one = instance;
  bool named = count == 0;
  for (size_t k = 0; k < count; k++) {
    const bool discards = strcmp(categories[k], "logStatusDiscard") == 0;
    if (!discards && strcmp(categories[k], "logStatusError") != 0)
      return failed(one, fmi3Error, "log category %.80s: use logStatusDiscard or logStatusError", categories[k]);
    named = named || discards;
  }
  one->logs_discards = named ? logging : one->logs_discards;
  return fmi3OK;
}

FMI_EXPORT fmi3Status FMI(EnterInitializationMode)(fmi3Instance instance, fmi3Boolean tolerant, fmi3Float64 tolerance,
    fmi3Float64 start, fmi3Boolean stops, fmi3Float64 stop)
{
  fmu *one = instance;
  if (one->now.mode != INSTANTIATED)
    return not_now(one, "fmi3EnterInitializationMode");
  if (0 * start != 0)
    return failed(one, fmi3Error, "the start time must be finite");
  one->now.values[TIME] = start;
  one->now.behind = true;
  one->now.mode = INITIALIZATION_MODE;
  return fmi3OK;
}

FMI_EXPORT fmi3Status FMI(Terminate)(fmi3Instance instance)
{
  fmu *one = instance;
  if (one->now.mode != STEP_MODE && one->now.mode != EVENT_MODE)
    return not_now(one, "fmi3Terminate");
  one->now.mode = TERMINATED;
  return fmi3OK;
}

FMI_EXPORT fmi3Status FMI(Reset)(fmi3Instance instance)
{
  fmu *one = instance;
  set_start(&one->now);
  return fmi3OK;
}

/* Variables of an FMU by value reference. Requires: INPUTS, INPUT_PARTS, INPUT_INDEX. */

/* Returns true if the model description has the reference; the internal parts of an input other than its value are
 * hidden. */
static bool is_known(fmi3ValueReference reference)
{
  const int64_t place = (int64_t)reference - FIRST_PARAMETER;
  for (int i = 0; i < INPUTS; i++)
    if (place > INPUT_INDEX[i] && place < INPUT_INDEX[i] + INPUT_PARTS)
      return false;
  return reference < REFERENCES;
}

static bool is_among(fmi3ValueReference reference, fmi3ValueReference first)
{
  return reference >= first && reference < first + M;
}

/* Parameters and inputs can be set at any time, the state before the first step. */
static bool is_settable(fmi3ValueReference reference, fmu_mode mode)
{
  if (reference >= FIRST_PARAMETER)
    return mode != TERMINATED;
  return mode < STEP_MODE && (is_among(reference, POSITIONS) || is_among(reference, MOVING));
}

static fmi3Status checked(const fmu *one, const fmi3ValueReference *references, size_t count, size_t size)
{
  if (count != size)
    return failed(one, fmi3Error, "%lu values for %lu variables", (unsigned long)size, (unsigned long)count);
  for (size_t k = 0; k < count; k++)
    if (!is_known(references[k]))
      return failed(one, fmi3Error, "unknown value reference %lu", (unsigned long)references[k]);
  return fmi3OK;
}

FMI_EXPORT fmi3Status FMI(GetFloat64)(fmi3Instance instance, const fmi3ValueReference *references, size_t count,
    fmi3Float64 *values, size_t size)
{
  fmu *one = instance;
  fmi3Status status = checked(one, references, count, size);
  for (size_t k = 0; status == fmi3OK && k < count; k++) {
    if (references[k] >= VELOCITIES && references[k] <= ENERGY)
      status = follow(one, fmi3Discard);
    values[k] = one->now.values[references[k]];
  }
  return status;
}

FMI_EXPORT fmi3Status FMI(SetFloat64)(fmi3Instance instance, const fmi3ValueReference *references, size_t count,
    const fmi3Float64 *values, size_t size)
{
  fmu *one = instance;
  const fmi3Status status = checked(one, references, count, size);
  if (status != fmi3OK)
    return status;
  for (size_t k = 0; k < count; k++)
    if (!is_settable(references[k], one->now.mode))
      return failed(one, fmi3Error, "value reference %lu cannot be set in this mode", (unsigned long)references[k]);
  for (size_t k = 0; k < count; k++)
    one->now.values[references[k]] = values[k];
  one->now.behind = true;
  return fmi3OK;
}

/* Integration from one communication point to the next. Requires: PROJECT, the projection onto constraints. */

#define NO_STEP 1e-9 /* relative to a step: remaining time that needs no step, e.g. with tabulated inputs */
#define TIME_ROUNDING (4 * DBL_EPSILON) /* relative to a time: error of a sum of steps */
#define MISTAKEN 1e3 /* relative to the slack of a time: a larger difference is a wrong start time, not rounding */
#define FAR_OFF 1e-2 /* violation of the constraints, relative to the positions, that is an error of the initial
                      * state */

/* PROJECT of a system without constraints. */
static inline int no_constraints(double t, const double *q0, const double *p0, const double *parameters, double *q1,
    double *p1, double *workspace)
{
  memcpy(q1, q0, sizeof(double) * M);
  memcpy(p1, p0, sizeof(double) * M);
  return STATUS(OK);
}

/* Projects the initial state onto the constraints; from then on the momenta are the independent values. */
static fmi3Status put_on_constraints(fmu *one)
{
  double *x = one->now.values, q[M], p[M], size = 0, moved = 0;
  const int status = PROJECT(x[TIME], x + POSITIONS, x + MOMENTA, x + FIRST_PARAMETER, q, p, one->workspace);
  if (status != STATUS(OK))
    return failed(one, fmi3Error, "projecting the initial state onto the constraints failed: %s", reason(status));
  for (int i = 0; i < M; i++) {
    size = fmax(size, fabs(q[i]));
    moved = fmax(moved, fabs(q[i] - x[POSITIONS + i]));
  }
  if (moved > FAR_OFF * size)
    return failed(one, fmi3Error, "the initial positions violate the constraints by %.1e (relative)", moved / size);
  memcpy(x + POSITIONS, q, sizeof q);
  memcpy(x + MOMENTA, p, sizeof p);
  return fmi3OK;
}

FMI_EXPORT fmi3Status FMI(ExitInitializationMode)(fmi3Instance instance)
{
  fmu *one = instance;
  double *x = one->now.values;
  fmi3Status status;
  if (one->now.mode != INITIALIZATION_MODE)
    return not_now(one, "fmi3ExitInitializationMode");
  status = follow(one, fmi3Error);
  if (status == fmi3OK)
    status = put_on_constraints(one);
  if (status != fmi3OK)
    return status;
  NAME(start)(&one->now.run, x[TIME], STEP, x + POSITIONS, x + MOMENTA);
  one->now.behind = CONSTRAINTS > 0;
  one->now.mode = one->has_event_mode ? EVENT_MODE : STEP_MODE;
  return fmi3OK;
}

/* Sets the values to a state at the time of the run. */
static void show_state(fmu *one, const double *q, const double *p)
{
  double *x = one->now.values;
  x[TIME] = one->now.run.t;
  memcpy(x + POSITIONS, q, sizeof(double) * M);
  memcpy(x + MOMENTA, p, sizeof(double) * M);
  one->now.behind = true;
}

/* Admissible error of a communication point. */
static double slack_at(double t)
{
  return NO_STEP * STEP + TIME_ROUNDING * fabs(t);
}

/* Number of steps to the next communication point, and their size: STEP if it fits, else that of the previous steps if
 * it fits, else an equal part of the interval. */
static long long plan(run_memory *run, double end)
{
  const double left = end - run->t, slack = slack_at(end), count = fmax(1, ceil((left - slack) / STEP));
  double length = left / count;
  if (fabs(count * STEP - left) <= slack)
    length = STEP;
  else if (fabs(count * run->h - left) <= slack)
    length = run->h;
  run->guess = run->h == length ? run->guess : 0;
  run->h = length;
  return (long long)count;
}

#ifdef EVENT_SETTINGS
/* Counts the crossings of a call in `remaining`. If one of them changes the state or ends the simulation, the values
 * become those before the change, which the run contains already. */
static void stop_at_event(fmu *one, int *remaining, double end, const run_report *report)
{
  event_watch *const watch = &one->now.watch;
  const event_memory *to = &one->memory;
  const event_crossing *const last = to->found + to->filled - 1;
  bool finished = watch->accumulated > 0;
  for (long long i = 0; i < to->filled; i++) {
    int *const left = remaining + to->found[i].function;
    finished |= *left > 0 && --*left == 0;
  }
  one->now.pending = watch->ended && to->filled > 0 && fabs(last->t - one->now.run.t) <= slack_at(last->t);
  one->now.whole = fmin(report->t + one->now.run.h, end);
  if (one->now.pending)
    show_state(one, last->q, last->p);
  watch->ended &= finished;
}

/* Advances to the next communication point, to the event that ends the simulation, or if the importer has an event mode
 * to the next one that changes the state. The step that an event cut is completed first. */
static int advance(fmu *one, double end, run_report *report)
{
  run_memory *const run = &one->now.run;
  event_watch *const watch = &one->now.watch;
  event_memory *const to = &one->memory;
  const double whole = one->now.whole;
  const bool cut = whole - run->t > slack_at(whole) && end - whole > slack_at(end);
  const double target = cut ? whole : end;
  int remaining[EVENTS], status = STATUS(OK);
  long long left = plan(run, target);
  memcpy(remaining, watch->remaining, sizeof remaining);
  for (int e = 0; one->returns_early && e < EVENTS; e++)
    watch->remaining[e] = watch->acts[e] ? 1 : remaining[e];
  one->now.pending = false;
  while (left > 0 && !watch->ended && !one->now.pending && fabs(target - run->t) > slack_at(target)) {
    status = NAME(advance_with_changes)(run, watch, target, NULL, left, one->now.values + FIRST_PARAMETER, NULL,
        MOST_CHANGES, to->t, to->q, to->p, to->length, to->iterations, to->number, MOST_CHANGES, to->found, &to->filled,
        report, one->workspace);
    if (status != STATUS(OK) || report->steps == 0)
      return status != STATUS(OK) ? status : STATUS(NOT_CONVERGED);
    left -= report->steps;
    show_state(one, run->q, run->p);
    if (one->returns_early)
      stop_at_event(one, remaining, end, report);
  }
  if (one->returns_early)
    memcpy(watch->remaining, remaining, sizeof remaining);
  return cut && !watch->ended && !one->now.pending ? advance(one, end, report) : STATUS(OK);
}
#else
/* Advances to the next communication point. */
static int advance(fmu *one, double end, run_report *report)
{
  run_memory *const run = &one->now.run;
  const int status = NAME(advance)(run, plan(run, end), 1, one->now.values + FIRST_PARAMETER, NULL, NULL, NULL, NULL,
      NULL, report, one->workspace);
  show_state(one, run->q, run->p);
  return status;
}
#endif

FMI_EXPORT fmi3Status FMI(DoStep)(fmi3Instance instance, fmi3Float64 point, fmi3Float64 size, fmi3Boolean no_return,
    fmi3Boolean *event, fmi3Boolean *terminate, fmi3Boolean *early, fmi3Float64 *last)
{
  fmu *one = instance;
  run_memory *run = &one->now.run;
  run_report report;
  int status;
  if (one->now.mode != STEP_MODE)
    return not_now(one, "fmi3DoStep");
  if (!(fabs(point - run->t) <= MISTAKEN * slack_at(point)))
    return failed(one, fmi3Error, "the communication point is t = %.17g, but the FMU is at t = %.17g", point, run->t);
  if (!(size > 0 && size / STEP < 1 / DBL_EPSILON))
    return failed(one, fmi3Error, "the communication step size %g must be positive, and less than 2^52 steps", size);
  one->before = one->now;
  status = advance(one, point + size, &report);
  if (status != STATUS(OK))
    one->now = one->before;
  *last = run->t;
  if (status != STATUS(OK))
    return failed(one, fmi3Discard, "the step at t = %g: %s", report.t, reason(status));
  *event = *terminate = *early = false;
#ifdef EVENT_SETTINGS
  *event = one->now.pending;
  *terminate = one->now.watch.ended && !one->now.pending;
  *early = one->now.pending && fabs(point + size - run->t) > slack_at(point + size);
#endif
  return fmi3OK;
}

/* Event mode: the values are those before the change of the state until the discrete states are updated. */

FMI_EXPORT fmi3Status FMI(EnterEventMode)(fmi3Instance instance)
{
  fmu *one = instance;
  if (!one->has_event_mode || one->now.mode != STEP_MODE)
    return not_now(one, "fmi3EnterEventMode");
  one->now.mode = EVENT_MODE;
  return fmi3OK;
}

FMI_EXPORT fmi3Status FMI(UpdateDiscreteStates)(fmi3Instance instance, fmi3Boolean *again, fmi3Boolean *terminate,
    fmi3Boolean *nominals, fmi3Boolean *states, fmi3Boolean *defined, fmi3Float64 *time)
{
  fmu *one = instance;
  if (one->now.mode != EVENT_MODE)
    return not_now(one, "fmi3UpdateDiscreteStates");
  *again = *terminate = *nominals = *states = *defined = false;
#ifdef EVENT_SETTINGS
  *states = one->now.pending;
  *terminate = one->now.watch.ended;
  one->now.pending = false;
  if (*states)
    show_state(one, one->now.run.q, one->now.run.p);
#endif
  return fmi3OK;
}

FMI_EXPORT fmi3Status FMI(EnterStepMode)(fmi3Instance instance)
{
  fmu *one = instance;
  if (one->now.mode != EVENT_MODE)
    return not_now(one, "fmi3EnterStepMode");
  one->now.mode = STEP_MODE;
  return fmi3OK;
}

/* States of an FMU: get, set, serialise. */

/* Copies the state to the importer's memory, which is allocated if there is none. */
static fmi3Status copy_state_to(const fmu *one, const void *state, fmi3FMUState *kept)
{
  *kept = *kept ? *kept : malloc(sizeof(fmu_state));
  if (!*kept)
    return failed(one, fmi3Error, "there is not enough memory for a state");
  memcpy(*kept, state, sizeof(fmu_state));
  return fmi3OK;
}

FMI_EXPORT fmi3Status FMI(GetFMUState)(fmi3Instance instance, fmi3FMUState *state)
{
  const fmu *one = instance;
  return copy_state_to(one, &one->now, state);
}

FMI_EXPORT fmi3Status FMI(SetFMUState)(fmi3Instance instance, fmi3FMUState state)
{
  fmu *one = instance;
  if (!state)
    return failed(one, fmi3Error, "the state to set is NULL");
  memcpy(&one->now, state, sizeof one->now);
  return fmi3OK;
}

FMI_EXPORT fmi3Status FMI(FreeFMUState)(fmi3Instance instance, fmi3FMUState *state)
{
  if (state) {
    free(*state);
    *state = NULL;
  }
  return fmi3OK;
}

FMI_EXPORT fmi3Status FMI(SerializedFMUStateSize)(fmi3Instance instance, fmi3FMUState state, size_t *size)
{
  *size = sizeof(fmu_state);
  return fmi3OK;
}

FMI_EXPORT fmi3Status FMI(SerializeFMUState)(fmi3Instance instance, fmi3FMUState state, fmi3Byte *bytes, size_t size)
{
  if (!state || size != sizeof(fmu_state))
    return failed(instance, fmi3Error, "the buffer of a state must have %lu bytes", (unsigned long)sizeof(fmu_state));
  memcpy(bytes, state, size);
  return fmi3OK;
}

FMI_EXPORT fmi3Status FMI(DeserializeFMUState)(fmi3Instance instance, const fmi3Byte *bytes, size_t size,
    fmi3FMUState *state)
{
  if (size != sizeof(fmu_state) || memcmp(bytes, TOKEN, sizeof TOKEN) != 0)
    return failed(instance, fmi3Error, "these bytes are not a serialized state of this FMU");
  return copy_state_to(instance, bytes, state);
}
