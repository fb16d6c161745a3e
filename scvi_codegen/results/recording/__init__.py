"""Runs of any length, recorded in a folder: interrupted, continued and read without a bit lost or torn.

    kepler.run/
      manifest.json       what runs: C source, flags, parameters, model, certificate; which builds made the states
      states-000000.npz   the first r states: t, q, p, iterations; and the run's memory after its last step
      states-000001.npz   the next r states, ...

A file of states is written beside its place and renamed into it. The last one grows by being replaced by a longer one,
so that one renaming brings states and the memory to go on from: however the process ends, what lies in the folder is
the run up to some step. A full file never changes. The memory in use does not depend on the length of the run.

The C text lies in the manifest: going on takes neither the model nor SymPy, and with another version of this package
the same text is compiled.
"""

from scvi_codegen.results.recording.reading import RecordedRun, load_run
from scvi_codegen.results.recording.writing import record_run, resume_run

__all__ = ["RecordedRun", "load_run", "record_run", "resume_run"]
