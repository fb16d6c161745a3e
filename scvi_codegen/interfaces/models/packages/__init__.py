"""Generated folders and FMUs: C code of a model, with an example and a description."""
