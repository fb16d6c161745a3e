"""What every room uses: errors, checks of arguments, files and the cache, displays, precision."""
