"""Recording of long runs in a folder: checkpoints, restart and reading, bitwise reproducible.

    kepler.run/
      manifest.json       the run: C source, flags, parameters, model; builds that computed the states
      states-000000.npz   the first r states: t, q, p, iterations; and the run's memory after its last step
      states-000001.npz   the next r states, ...

A file of states is written under a temporary name and renamed. The last file grows by being replaced by a longer one,
so that one atomic operation stores states and checkpoint together: however the process ends, the folder contains the
run up to some step. A full file never changes. Memory use does not depend on the length of the run.

The manifest contains the C source: a restart requires neither the model nor SymPy, and another version of this package
compiles the same source.
"""

from scvi_codegen.runs.recording.reading import RecordedRun, load_run
from scvi_codegen.runs.recording.writing import record_run, resume_run

__all__ = ["RecordedRun", "load_run", "record_run", "resume_run"]
