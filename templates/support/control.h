/* Acceptance of adaptive steps of systems with few coordinates. Requires: trials.h. Include before advance_to.h. */

/* Adds the increments of the accepted step to the state. */
static inline void take_step(run_memory *run, trial *now)
{
  add_compensated(now->at.q, now->at.carry_q, now->dq);
  add_compensated(now->at.p, now->at.carry_p, now->dp);
  if (larger(now->error, now->apart) > run->error) {
    run->error = larger(now->error, now->apart);
    run->error_t = now->at.t;
  }
  if (now->last) {
    now->at.t = now->t_end;
    now->at.t_low = 0;
    run->guess = 0;
  } else {
    add_to_time(&now->at.t, &now->at.t_low, now->step.h);
    choose_size(run, now);
  }
  run->step++;
}
