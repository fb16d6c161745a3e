/* Instances of an FMU and their modes (FMI 3.0, co-simulation). Requires: the integrator's header, the FMI header, and
 * NAME, STATUS, WORKSPACE, TOKEN, STEP, M, PARAMETERS, BY_VELOCITY, and the start values. */

enum { LONGEST_MESSAGE = 240 };

typedef NAME(run) run_memory;
typedef NAME(report) run_report;

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
  TERMINATED
} fmu_mode;

/* The complete state of an instance: a copy restores it bit for bit. */
typedef struct {
  char token[sizeof TOKEN]; /* of the FMU that the state belongs to */
  fmu_mode mode;
  bool behind; /* 1 if dependent values are out of date */
  double values[REFERENCES];
  NAME(run)
  run;
} fmu_state;

typedef struct {
  fmu_state now;
  NAME(run)
  before; /* before the last step, to restore after a failure */
  fmi3InstanceEnvironment environment;
  fmi3LogMessageCallback log;
  bool logs_discards;
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
  switch (status) {
  case STATUS(NOT_CONVERGED):
    return "the iteration on the stage equations did not converge: use a smaller step";
  case STATUS(SINGULAR):
    return "the Newton matrix or the mass matrix is singular";
  case STATUS(NOT_FINITE):
    return "a value is infinite or NaN";
  default:
    return "the iteration converged to a spurious solution of the stage equations: use a smaller step";
  }
}

static void set_start(fmu_state *now)
{
  memset(now, 0, sizeof *now);
  memcpy(now->token, TOKEN, sizeof TOKEN);
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
  (void)name, (void)resources, (void)visible, (void)early, (void)required, (void)update;
  if (!one)
    return NULL;
  one->environment = environment;
  one->log = log;
  one->logs_discards = logging;
  set_start(&one->now);
  if (!token || strcmp(token, TOKEN) != 0)
    wrong = "the instantiation token belongs to another FMU: use the token of this modelDescription.xml";
  else if (events || count > 0)
    wrong = "this FMU has no event mode and no intermediate variables";
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
  (void)tolerant, (void)tolerance, (void)stops, (void)stop;
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
  if (one->now.mode != STEP_MODE)
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
