/* Vectors of pairs from words, from numbers, and from the array of parameters. */
static inline ddl ddl_of(dd x)
{
  const ddl result = {lanes_of(x.high), lanes_of(x.low)};
  return result;
}

static inline ddl ddl_of_words(lanes high, lanes low)
{
  const ddl result = {high, low};
  return result;
}

#define PARAMETER_OF_LANES(i) ddl_of_words(parameters[i], parameters[PARAMETERS + (i)])

/* Lane j. */
static inline double lane_of(const lanes *x, int j)
{
  double value; /* a cast of the pointer would alias */
  memcpy(&value, (const char *)x + (size_t)j * sizeof value, sizeof value);
  return value;
}
