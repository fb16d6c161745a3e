"""Command ``scvi-codegen cache``: the cache of compiled integrators."""

from dataclasses import asdict

import click

from scvi_codegen.common.cache import cache_folder, cache_info, clear_cache
from scvi_codegen.interfaces.cli.command_group import reporting, tell


@click.command()
@click.argument("action", type=click.Choice(["info", "clear", "path"]), default="info")
@reporting
def cache(action: str) -> None:
    """Show the cache of compiled integrators (info), empty it (clear), or print its folder (path).

    SCVI_CODEGEN_CACHE sets another folder. If the entries exceed SCVI_CODEGEN_CACHE_SIZE (as in 500M or 2G; default 1G;
    0: no limit), the least recently used ones are removed.

    \b
    Example:
      scvi-codegen cache info
    """
    if action == "clear":
        count = clear_cache()
        tell(f"removed {count:,} bytes from {cache_folder()}", folder=cache_folder(), removed=count)
    elif action == "path":
        tell(str(cache_folder()), folder=cache_folder())
    else:
        info = cache_info()
        tell(str(info), **asdict(info))
