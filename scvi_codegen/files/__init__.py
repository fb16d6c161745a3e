"""Files on disk: atomic writes, the cache folder, the templates, export formats, TOML."""
