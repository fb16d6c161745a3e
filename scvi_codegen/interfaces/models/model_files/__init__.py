"""Model files in TOML: reading, writing, and the tables and arrays that they refer to."""
