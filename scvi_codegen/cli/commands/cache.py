"""Command ``scvi-codegen cache``: the cache of compiled integrators."""

from __future__ import annotations

from dataclasses import asdict

import click

from scvi_codegen.cli.frame import reporting, tell
from scvi_codegen.files.cache import cache_folder, cache_info, clear_cache

__all__ = ["cache"]


@click.command()
@click.argument("action", type=click.Choice(["info", "clear", "path"]), default="info")
@reporting
def cache(action: str) -> None:
    """Show what is in the cache of compiled integrators (info), empty it (clear), or print where it is (path).

    SCVI_CODEGEN_CACHE names another folder. When the entries are larger than SCVI_CODEGEN_CACHE_SIZE (as in 500M or 2G;
    1G if it is not set; 0 for no limit), those used least recently are removed.

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
