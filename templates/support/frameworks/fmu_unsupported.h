#include "fmu.h"

/* Functions that FMI 3.0 requires and this FMU does not support: variables of other types, events, clocks,
 * derivatives, model exchange, scheduled execution. Each returns an error. */

#define ABSENT(word, ...)                                                       \
  FMI_EXPORT fmi3Status FMI(word)(fmi3Instance instance, __VA_ARGS__)           \
  {                                                                             \
    return failed(instance, fmi3Error, "this FMU does not support fmi3" #word); \
  }
#define NO_MODE(word)                                                           \
  FMI_EXPORT fmi3Status FMI(word)(fmi3Instance instance)                        \
  {                                                                             \
    return failed(instance, fmi3Error, "this FMU does not support fmi3" #word); \
  }
#define NO_VARIABLES(type)                                                                                        \
  FMI_EXPORT fmi3Status FMI(Get##type)(fmi3Instance instance, const fmi3ValueReference *references, size_t count, \
      fmi3##type *values, size_t size)                                                                            \
  {                                                                                                               \
    return count ? failed(instance, fmi3Error, "this FMU has no variables of type " #type) : fmi3OK;              \
  }                                                                                                               \
  FMI_EXPORT fmi3Status FMI(Set##type)(fmi3Instance instance, const fmi3ValueReference *references, size_t count, \
      const fmi3##type *values, size_t size)                                                                      \
  {                                                                                                               \
    return count ? failed(instance, fmi3Error, "this FMU has no variables of type " #type) : fmi3OK;              \
  }
#define ONLY_CO_SIMULATION(word, ...)                                                                             \
  FMI_EXPORT fmi3Instance FMI(word)(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible, \
      fmi3Boolean logging, fmi3InstanceEnvironment environment, __VA_ARGS__)                                      \
  {                                                                                                               \
    if (log)                                                                                                      \
      log(environment, fmi3Error, "logStatusError", "this FMU supports only co-simulation");                      \
    return NULL;                                                                                                  \
  }

/* clang-format off */
NO_VARIABLES(Float32)
NO_VARIABLES(Int8)
NO_VARIABLES(UInt8)
NO_VARIABLES(Int16)
NO_VARIABLES(UInt16)
NO_VARIABLES(Int32)
NO_VARIABLES(UInt32)
NO_VARIABLES(Int64)
NO_VARIABLES(UInt64)
NO_VARIABLES(Boolean)
NO_VARIABLES(String)
ABSENT(GetBinary, const fmi3ValueReference *references, size_t count, size_t *sizes, fmi3Binary *values, size_t size)
ABSENT(SetBinary, const fmi3ValueReference *references, size_t count, const size_t *sizes, const fmi3Binary *values,
    size_t size)
ABSENT(GetClock, const fmi3ValueReference *references, size_t count, fmi3Clock *values)
ABSENT(SetClock, const fmi3ValueReference *references, size_t count, const fmi3Clock *values)
ABSENT(GetNumberOfVariableDependencies, fmi3ValueReference reference, size_t *count)
ABSENT(GetVariableDependencies, fmi3ValueReference dependent, size_t *elements, fmi3ValueReference *independents,
    size_t *places, int *kinds, size_t count)
ABSENT(GetDirectionalDerivative, const fmi3ValueReference *unknowns, size_t unknown, const fmi3ValueReference *knowns,
    size_t known, const double *seed, size_t seeds, double *sensitivity, size_t size)
ABSENT(GetAdjointDerivative, const fmi3ValueReference *unknowns, size_t unknown, const fmi3ValueReference *knowns,
    size_t known, const double *seed, size_t seeds, double *sensitivity, size_t size)
ABSENT(GetOutputDerivatives, const fmi3ValueReference *references, size_t count, const fmi3Int32 *orders,
    fmi3Float64 *values, size_t size)
ABSENT(GetIntervalDecimal, const fmi3ValueReference *references, size_t count, fmi3Float64 *intervals, int *qualifiers)
ABSENT(GetIntervalFraction, const fmi3ValueReference *references, size_t count, fmi3UInt64 *counters,
    fmi3UInt64 *resolutions, int *qualifiers)
ABSENT(GetShiftDecimal, const fmi3ValueReference *references, size_t count, fmi3Float64 *shifts)
ABSENT(GetShiftFraction, const fmi3ValueReference *references, size_t count, fmi3UInt64 *counters,
    fmi3UInt64 *resolutions)
ABSENT(SetIntervalDecimal, const fmi3ValueReference *references, size_t count, const fmi3Float64 *intervals)
ABSENT(SetIntervalFraction, const fmi3ValueReference *references, size_t count, const fmi3UInt64 *counters, const
    fmi3UInt64 *resolutions)
ABSENT(SetShiftDecimal, const fmi3ValueReference *references, size_t count, const fmi3Float64 *shifts)
ABSENT(SetShiftFraction, const fmi3ValueReference *references, size_t count, const fmi3UInt64 *counters, const
    fmi3UInt64 *resolutions)
ABSENT(CompletedIntegratorStep, fmi3Boolean no_return, fmi3Boolean *event, fmi3Boolean *terminate)
ABSENT(SetTime, fmi3Float64 time)
ABSENT(SetContinuousStates, const fmi3Float64 *states, size_t count)
ABSENT(GetContinuousStateDerivatives, fmi3Float64 *derivatives, size_t count)
ABSENT(GetEventIndicators, fmi3Float64 *indicators, size_t count)
ABSENT(GetContinuousStates, fmi3Float64 *states, size_t count)
ABSENT(GetNominalsOfContinuousStates, fmi3Float64 *nominals, size_t count)
ABSENT(GetNumberOfEventIndicators, size_t *count)
ABSENT(GetNumberOfContinuousStates, size_t *count)
ABSENT(ActivateModelPartition, fmi3ValueReference clock, fmi3Float64 time)
NO_MODE(EnterConfigurationMode)
NO_MODE(ExitConfigurationMode)
NO_MODE(EvaluateDiscreteStates)
NO_MODE(EnterContinuousTimeMode)
ONLY_CO_SIMULATION(InstantiateModelExchange, fmi3LogMessageCallback log)
ONLY_CO_SIMULATION(InstantiateScheduledExecution, fmi3LogMessageCallback log, fmi3Callback clock_update,
    fmi3Callback lock, fmi3Callback unlock)
/* clang-format on */
