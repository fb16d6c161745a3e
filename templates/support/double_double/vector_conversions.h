/* Vectors of pairs from words and from numbers. */
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

/* Lane j. */
static inline double lane_of(const lanes *x, int j)
{
  double value; /* a cast of the pointer would alias */
  memcpy(&value, (const char *)x + (size_t)j * sizeof value, sizeof value);
  return value;
}
