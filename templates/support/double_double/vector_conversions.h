/* Vectors of pairs from words, from numbers, and from the array of parameters. */
static inline ddl ddl_of(dd x)
{
  return (ddl){lanes_of(x.high), lanes_of(x.low)};
}

#define ddl_of_words(high_words, low_words) ((ddl){high_words, low_words})
#define PARAMETER_OF_LANES(i) ddl_of_words(parameters[i], parameters[PARAMETERS + (i)])

/* Lane j. */
static inline double lane_of(const lanes *x, int j)
{
  double value; /* a cast of the pointer would alias */
  memcpy(&value, (const char *)x + (size_t)j * sizeof value, sizeof value);
  return value;
}
