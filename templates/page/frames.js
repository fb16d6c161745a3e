// The number of steps in a frame; the clock, in milliseconds, is an argument.
/** Returns a scheduler of steps, such that these and the drawing take at most `budget` of a frame, unless one step takes longer. */
function scheduler(clock, budget = 12) {
  const RESOLUTION = 0.1; // of clocks of browsers, which are rounded
  let stepCost = Infinity, drawCost = 2, until = 0;
  return {
    /** Begins a frame, or another time in which steps are performed. */
    begin(time = Math.max(2, budget - 1.5 - drawCost)) { until = clock() + time; },
    /** Performs the steps that are needed while there is time, in parts that end in time even if steps are four times as slow as expected; returns their number. */
    perform(needed, take) {
      let performed = 0;
      for (let wanted = needed(), began = clock(); wanted > 0 && (performed ? began + stepCost : began) < until; wanted = needed()) {
        const now = Math.max(1, Math.min(wanted, Math.floor(Math.min(1, (until - began) / 4) / stepCost)));
        take(now, wanted);
        const ended = clock(), cost = (ended - began + RESOLUTION) / now;
        stepCost = cost > stepCost || stepCost === Infinity ? cost : 0.5 * (stepCost + cost);
        performed += now; began = ended;
      }
      return performed;
    },
    /** Notes the duration of a drawing. */
    drawn(time) { drawCost = Math.max(0.9 * drawCost + 0.1 * time, Math.min(time, 0.75 * budget)); },
  };
}
