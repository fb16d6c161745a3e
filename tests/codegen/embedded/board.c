/* What a bare ARM board under QEMU lacks of an operating system: a vector table, and text and exit by semihosting. On a
 * computer the same two functions call the C library. */
#include "board.h"

#ifdef __arm__
#include <stdint.h>

enum { WRITE_TEXT = 0x04, EXIT = 0x18, APPLICATION_EXIT = 0x20026, RUN_TIME_ERROR = 0x20023 };
#define COPROCESSORS (*(volatile uint32_t *)0xE000ED88)

int main(void);
extern char stack_top[], data_begin[], data_end[], data_image[], zero_begin[], zero_end[];

static void ask_host(int operation, const void *argument)
{
  register int r0 __asm__("r0") = operation;
  register const void *r1 __asm__("r1") = argument;
  __asm__ volatile("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory");
}

void put_text(const char *text)
{
  ask_host(WRITE_TEXT, text);
}

void leave(int status)
{
  ask_host(EXIT, (const void *)(uintptr_t)(status ? RUN_TIME_ERROR : APPLICATION_EXIT));
  for (;;)
    ;
}

static void reset(void)
{
  COPROCESSORS |= 0xFu << 20; /* the floating-point unit, where there is one */
  __asm__ volatile("dsb\n isb");
  for (char *to = data_begin, *from = data_image; to < data_end;)
    *to++ = *from++;
  for (char *to = zero_begin; to < zero_end;)
    *to++ = 0;
  leave(main());
}

static void fault(void)
{
  put_text("fault\n");
  leave(1);
}

__attribute__((section(".vectors"), used)) static const void *const vectors[] = {
  stack_top, (const void *)reset, (const void *)fault, (const void *)fault, (const void *)fault, (const void *)fault,
  (const void *)fault
};

#else
#include <stdio.h>
#include <stdlib.h>

void put_text(const char *text)
{
  fputs(text, stdout);
}

void leave(int status)
{
  exit(status);
}
#endif
