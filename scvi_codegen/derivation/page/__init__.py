"""The page from L to C: every formula beside the C function that computes it."""
