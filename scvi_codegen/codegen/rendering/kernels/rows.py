"""Forces of arrays row by row, as C: passes that continue a row as soon as its forces are added."""

from collections.abc import Sequence

from scvi_codegen.codegen.ir.kernel import RolledKernel
from scvi_codegen.codegen.ir.program import Layout
from scvi_codegen.codegen.rendering.kernels.loop_nests import Sharing, function_of_sizes, sharing_of, size_text
from scvi_codegen.codegen.rendering.kernels.simd import loop_functions


def _reach(layout: Layout, rolled: RolledKernel) -> int | None:
    """Return the largest distance of coupled rows, the entries with the same first index; ``None`` if unknown."""
    loops, entries = rolled.loops, (*rolled.reads, *rolled.writes)
    if not loops or loops[0].near or any(not access.places for access in entries):
        return None
    rows = [access.places[0] for access in entries]
    along = all(row.index == loops[0].index and not (row.table or row.minus or row.base.name) for row in rows)
    whole = {array.axes[0] for array in layout.coordinates if array.axes} == {loops[0].end} or not loops[0].periodic
    return max(abs(row.base.number) for row in rows) if along and whole else None


def rows_text(layout: Layout, forces: Sequence[RolledKernel]) -> tuple[str, str] | None:
    """Return constants and functions of forces row by row, for templates/support/arrays/array_rows.h.

    ``None`` unless all coordinates have the same first axis, and at most one term group couples rows, at a distance.
    In other loops over rows functions of a library must not occur, since vectors of them round differently.
    """
    axes = {array.axes[:1] for array in layout.coordinates}
    reaches = [reach for rolled in forces if (reach := _reach(layout, rolled)) is not None]
    if len(axes) != 1 or axes == {()} or not forces or len(reaches) < len(forces) or sum(map(bool, reaches)) > 1:
        return None
    lead, ((axis,),) = reaches.index(max(reaches)), axes
    coupling, before, behind = forces[lead], forces[:lead], forces[lead + 1 :]
    others = [rolled.kernel for rolled in (*before, *behind) if len(rolled.loops) == 1]
    if any(sharing_of(rolled) is not Sharing.IN_TURN for rolled in forces) or loop_functions(others):
        return None
    chunked, first = len(coupling.loops) == 1, min(access.places[0].base.number for access in coupling.reads)
    constants = {
        "REACH": reaches[lead],
        "CHUNKED_ROWS": int(chunked),
        "BEFORE_CHUNKS": -min(0, first) if chunked and coupling.loops[0].periodic else 0,
    }
    rows = function_of_sizes(layout, "static long long rows_of(const problem *arrays)", [f"return {size_text(axis)};"])
    constants_text = f"enum {{ {', '.join(f'{name} = {number}' for name, number in constants.items())} }};"
    parts = (("prepare", before), ("add", (coupling,)), ("complete", behind))
    return (
        f"{constants_text}\n#define share_rows share_{coupling.kernel.name}\n\n{rows}",
        "\n\n".join(_part(*part) for part in parts),
    )


def _part(name: str, forces: Sequence[RolledKernel]) -> str:
    """Return the function of some term groups."""
    head = f"static void {name}_rows(const sweep *of, section rows)"
    lines = [head, "{", "  window here;", "  (void)of, (void)rows, (void)here;"]
    for rolled in forces:
        group = rolled.kernel.name
        lines.append(f"  here = window_of_rows(share_{group}(of->run, of->arrays, of->work->n), rows);")
        lines.append(f"  add_{group}(of->arrays, of->X, of->t, of->by, of->F, &here);")
    return "\n".join([*lines, "}"])
