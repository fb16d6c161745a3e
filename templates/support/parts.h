/* Parts of large kernels stay functions of their own: compilers take ever longer over ever longer ones. */
#ifdef __GNUC__
#define SCVI_NOINLINE __attribute__((noinline))
#else
#define SCVI_NOINLINE
#endif
