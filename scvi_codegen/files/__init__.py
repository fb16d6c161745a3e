"""What lies on disk, whatever is in it: whole files, the cache folder, the templates, formats of states, TOML."""
