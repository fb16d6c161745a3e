/* Prints the bits of the states of a run, a line a step: status, iterations, q, p. */
#include <string.h>

#include "board.h"
#include "integrator.h"
#include "start.h"

enum { M = INTEGRATOR_COORDINATES };

static REAL workspace[INTEGRATOR_WORKSPACE];
static integrator_run run;

static void put_bits(const void *number, unsigned size)
{
  unsigned char bytes[8];
  char text[2 * sizeof bytes + 2] = " ";
  memcpy(bytes, number, size);
  for (unsigned k = 0; k < 2 * size; k++) /* little-endian, as all machines here are */
    text[1 + k] = "0123456789abcdef"[(bytes[size - 1 - k / 2] >> (k % 2 ? 0 : 4)) & 15];
  text[1 + 2 * size] = '\0';
  put_text(text);
}

int main(void)
{
  integrator_start(&run, 0, H, q0, p0);
  for (int k = 0; k < STEPS; k++) {
    REAL t, q[M], p[M];
    int iterations = 0;
    integrator_report report;
    const int status = integrator_advance(&run, 1, 1, parameters, NULL, &t, q, p, &iterations, &report, workspace);
    put_bits(&status, sizeof status);
    put_bits(&iterations, sizeof iterations);
    for (int i = 0; i < M; i++)
      put_bits(q + i, sizeof *q);
    for (int i = 0; i < M; i++)
      put_bits(p + i, sizeof *p);
    put_text("\n");
    if (status)
      return 1;
  }
  return 0;
}
