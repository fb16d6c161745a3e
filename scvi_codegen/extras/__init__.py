"""Products beyond the core, one folder each; they import the api and each other downward."""
