/* Pairs from words, and from the array of parameters. */
static inline dd dd_of(double high, double low)
{
  return (dd){high, low};
}

#define PARAMETER(i) dd_of(parameters[i], parameters[PARAMETERS + (i)])
