"""Problems of the benchmark, and their reference solutions."""
