"""Who runs in the benchmark: this project, its peers, and what they are timed by."""
