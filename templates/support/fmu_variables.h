/* Variables of an FMU by value reference. Requires: fmu.h, INPUTS, INPUT_PARTS, INPUT_INDEX. */

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
