/* Pairs from words, and from the array of parameters. */
static inline dd dd_of(double high, double low)
{
  const dd result = {high, low};
  return result;
}

#define PARAMETER(i) dd_of(parameters[i], parameters[PARAMETERS + (i)])
