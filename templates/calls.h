/* Runs whose arguments and results are one struct. Requires: NAME, calls_declarations.h; HAS_ADVANCE_TO,
 * HAS_MEASURES_GROWTH, HAS_STEP_ERROR and HAS_REJECTED where the source has these. Functions are called by volatile
 * pointers: not inlined, so that the bits of steps do not depend on these callers. */

static int NAME(call_store)(const NAME(call) *c, long long row, long long steps, long long every)
{
  double *t = c->t + row, *q = c->q + row * c->coordinates, *p = c->p + row * c->coordinates;
  __typeof__(NAME(advance)) *volatile fixed = NAME(advance);
#ifdef HAS_ADVANCE_TO
  __typeof__(NAME(advance_to)) *volatile adaptive = NAME(advance_to);
  if (c->h == 0.0)
    return adaptive(c->run, c->t_end, c->tolerance, steps, every, c->parameters, c->options, t, q, p,
        c->iterations + row, c->report, c->workspace);
#endif
  return fixed(c->run, steps, every, c->parameters, c->options, t, q, p, c->iterations + row, c->report, c->workspace);
}

/* Takes steps and stores states. */
int NAME(call_advance)(const NAME(call) *call, long long steps, long long every)
{
  return NAME(call_store)(call, 0, steps, every);
}

/* Starts a run, takes steps and stores states, the initial one first. */
int NAME(call_integrate)(NAME(call) *c, long long steps, long long every)
{
  c->t[0] = c->start[0];
  c->iterations[0] = 0;
  for (long long i = 0; i < c->coordinates; i++) {
    c->q[i] = c->start[1 + i];
    c->p[i] = c->start[1 + c->coordinates + i];
  }
  NAME(start)(c->run, c->t[0], c->h, c->q, c->p);
#ifdef HAS_MEASURES_GROWTH
  c->run->measures_growth = c->measures_growth;
#endif
  int status = NAME(call_store)(c, 1, steps, every);
  c->steps = c->report->steps;
  c->stored = c->steps / every;
#ifdef HAS_STEP_ERROR
  c->error = NAME(step_error)(c->run);
  c->error_t = c->run->error_t;
#endif
#ifdef HAS_ADVANCE_TO
  c->stored = c->h == 0.0 ? c->report->stored : c->stored;
#endif
#ifdef HAS_REJECTED
  c->rejected = c->run->rejected;
#endif
  if (c->h == 0.0 && c->sizes)
    for (long long k = 0; k < c->stored; k++)
      c->sizes[k] = c->t[k + 1] - c->t[k];
  if (status || c->h != 0.0 || !c->has_energies)
    return status;
  long long last = c->stored, row = last * c->coordinates;
  if (NAME(energies)(1 + (last == 1), c->t, c->q, c->p, c->parameters, c->energies, c->workspace) ||
      (last != 1 && NAME(energies)(1, c->t + last, c->q + row, c->p + row, c->parameters, c->energies + 1, c->workspace)))
    c->energies[0] = c->energies[1] = 0.0; /* undefined */
  return 0;
}
