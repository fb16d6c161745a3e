/* Pairs from words, from numbers, and from the arrays of parameters. */
static inline dd dd_of(double high, double low)
{
  const dd result = {high, low};
  return result;
}

static inline ddl ddl_of(dd x)
{
  const ddl result = {lanes_of(x.high), lanes_of(x.low)};
  return result;
}

#define PARAMETER(i) dd_of(parameters[i], parameters[PARAMETERS + (i)])
#define PARAMETER_OF_LANES(i) ddl_of_words(parameters[i], parameters[PARAMETERS + (i)])

static inline ddl ddl_of_words(lanes high, lanes low)
{
  const ddl result = {high, low};
  return result;
}
