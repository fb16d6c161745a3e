#ifndef SUPPORT_VECTOR_WIDTH_H
#define SUPPORT_VECTOR_WIDTH_H

/* Bytes of the widest vector register. GCC stores longer vectors in memory. */
#ifndef VECTOR_BYTES
#if defined(__AVX512F__)
#define VECTOR_BYTES 64
#elif defined(__AVX__)
#define VECTOR_BYTES 32
#else
#define VECTOR_BYTES 16
#endif
#endif

#endif
