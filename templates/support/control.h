/* What makes the step that was found the state of few coordinates. Before it: trials.h. After it: advance_to.h. */

/* Makes the step that was found the state. */
static inline void take_step(run_memory *run, trial *now)
{
  add_compensated(now->at.q, now->at.carry_q, now->dq);
  add_compensated(now->at.p, now->at.carry_p, now->dp);
  if (now->error > run->error) {
    run->error = now->error;
    run->error_t = now->at.t;
  }
  if (now->last) {
    now->at.t = now->t_end;
    now->at.t_low = 0;
    run->guess = 0;
  } else {
    add_to_time(&now->at.t, &now->at.t_low, now->step.h);
    choose_length(run, now);
  }
  run->step++;
}
