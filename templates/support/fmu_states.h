/* States of an FMU: get, set, serialise. Requires: fmu.h. */

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
  (void)instance;
  if (state) {
    free(*state);
    *state = NULL;
  }
  return fmi3OK;
}

FMI_EXPORT fmi3Status FMI(SerializedFMUStateSize)(fmi3Instance instance, fmi3FMUState state, size_t *size)
{
  (void)instance, (void)state;
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
