"""Page from L to C: every formula next to the C function that computes it."""
