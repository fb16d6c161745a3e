/* Parts of large kernels that must not be inlined: compile times grow faster than the length of a function. */
#ifdef __GNUC__
#define SCVI_NOINLINE __attribute__((noinline))
#else
#define SCVI_NOINLINE
#endif
