/* A thread of a GPU is one trajectory, or with POINT_THREADS a point of its steps: names that CUDA C++ lacks without
 * headers of the standard library. OF_THREAD(x, j) is the x of the thread of point j. Other compilers, which check this
 * text on a processor, define KERNEL, TRAJECTORY, OWN_POINT and OF_THREAD. */
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
#define OWN_POINT ((int)(threadIdx.x % POINT_THREADS))
#define OF_THREAD(value, j) \
  __shfl_sync(((1u << POINT_THREADS) - 1) << (threadIdx.x % 32 - OWN_POINT), value, j, POINT_THREADS)

/* x^(-1/2) to 20 bits, by the special function unit. */
static inline double device_inverse_root(double x)
{
  double y;
  asm("rsqrt.approx.ftz.f64 %0, %1;" : "=d"(y) : "d"(x));
  return y;
}
#endif
