/* Pairs from words, and from the array of parameters. */
#define dd_of(high_word, low_word) ((dd){high_word, low_word})
#define PARAMETER(i) dd_of(parameters[i], parameters[PARAMETERS + (i)])
