/* A thread of a GPU is one trajectory: names that CUDA C++ lacks without headers of the standard library. Other
 * compilers, which check this text on a processor, define KERNEL and TRAJECTORY. */
#define SCALAR_LANES
#ifdef __CUDACC__
#define restrict __restrict__
#define DBL_EPSILON 2.220446049250313e-16
#define DBL_MIN 2.2250738585072014e-308
#define INFINITY __longlong_as_double(0x7ff0000000000000LL)
#define NAN __longlong_as_double(0x7ff8000000000000LL)
#define KERNEL extern "C" __global__ void
#define TRAJECTORY ((long long)blockIdx.x * blockDim.x + threadIdx.x)
#define SCVI_INVERSE_ROOT device_inverse_root

/* x^(-1/2) to 20 bits, by the special function unit. */
static inline double device_inverse_root(double x)
{
  double y;
  asm("rsqrt.approx.ftz.f64 %0, %1;" : "=d"(y) : "d"(x));
  return y;
}
#endif
