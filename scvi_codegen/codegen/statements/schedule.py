"""Order and storage of the statements of a step whose points are computed in loops.

Points are in loops over groups of them, one group a vector. A statement that sums over points, or reads the point
before, of a value that the present loop computes needs all its points: there the loop ends. A value is computed in the
loop that first uses it, and stored only if a later loop reads it, or sums over its points.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace

from scvi_codegen.methods.statements import (
    Apply,
    Assign,
    At,
    Expression,
    Former,
    Operation,
    OverPoints,
    Read,
    Statement,
)

Simple = Assign | Apply


@dataclass(frozen=True, slots=True)
class PointLoop:
    """Loop over groups of points; values ``summed_later`` by other loops must be in memory when it ends."""

    body: tuple[Simple, ...]
    summed_later: tuple[str, ...]


def names_read(statement: Statement) -> set[str]:
    """Return the names of the quantities that a statement reads; of increments also those that it changes."""
    match statement:
        case Assign(target=target, value=value, operator=operator):
            return _names(value) | ({target.name} if operator else set())
        case Apply(argument=argument, time=time):
            return {argument} | (_names(time) if time is not None else set())
    raise AssertionError(statement)


def target_name(statement: Statement) -> str | None:
    """Return the name of the quantity that a statement computes."""
    match statement:
        case Assign(target=target) | Apply(target=Read() as target):
            return target.name
    return None


def over_points(expression: Expression) -> set[str]:
    """Return the names of the quantities of which an expression needs other points."""
    match expression:
        case OverPoints(value=value) | Former(value=value):
            return {value.name}
        case Operation(operands=operands):
            return set[str]().union(*map(over_points, operands))
    return set()


def point_loops(statements: Sequence[Statement], stored: Collection[str]) -> list[PointLoop]:
    """Return the loops over points of statements, of which the stored quantities are in memory in any case."""
    blocks = _blocks([_simple(statement) for statement in statements])
    _delay(blocks, stored)
    loops = []
    for number, block in enumerate(blocks):
        later = set[str]().union(*(_needs(statement) for after in blocks[number + 1 :] for statement in after))
        summed = dict.fromkeys(name for statement in block if (name := target_name(statement)) in later and name)
        loops.append(PointLoop(tuple(block), tuple(summed)))
    return loops


def in_registers(loop: PointLoop, stored: Collection[str]) -> PointLoop:
    """Return a loop in which stored quantities that it computes more than once are registers until its end."""
    targets = [statement.target for statement in loop.body if statement.target is not None]
    letters = {target.name: target.at.letter for target in reversed(targets) if target.at}  # those of the first values
    counts = Counter(target.name for target in targets)
    of_operations = {target_name(statement) for statement in loop.body if isinstance(statement, Apply)}
    held = {
        name: At(letters[name])
        for name, count in counts.items()
        if name in stored and (count > 1 or name in of_operations)
    }
    body, begun = list[Simple](), dict[str, str]()
    for statement in loop.body:
        own = _renamed(statement, begun)
        target = own.target
        if target is not None and target.name in held:
            begun[target.name] = f"{target.name}_now"
            own = replace(own, target=replace(target, name=begun[target.name]))
        body.append(own)
    body += [Assign(Read(name, at), Read(f"{name}_now", at)) for name, at in held.items()]
    return replace(loop, body=tuple(body))


def _simple(statement: Statement) -> Simple:
    assert isinstance(statement, Assign | Apply), "a repetition is not part of a loop over points"
    return statement


def _blocks(statements: Sequence[Simple]) -> list[list[Simple]]:
    """Cut statements where one needs other points of a value that the block computes."""
    blocks, computed = [list[Simple]()], set[str | None]()
    for statement in statements:
        if _needs(statement) & computed:
            blocks.append([])
            computed = set()
        blocks[-1].append(statement)
        computed.add(target_name(statement))
    return blocks


def _delay(blocks: list[list[Simple]], stored: Collection[str]) -> None:
    """Move local values to the block that first uses them, if no other points of them are needed."""
    statements = [statement for block in blocks for statement in block]
    for number in range(len(blocks) - 2, -1, -1):
        for statement in reversed(blocks[number][:]):
            name = target_name(statement)
            if name is None or name in stored:
                continue
            times_computed = sum(target_name(other) == name for other in statements)
            if times_computed > 1 or any(name in _needs(other) for other in statements):
                continue
            users = [k for k, block in enumerate(blocks) if any(name in names_read(other) for other in block)]
            if users and min(users) > number:
                blocks[number].remove(statement)
                blocks[min(users)].insert(0, statement)


def _needs(statement: Simple) -> set[str]:
    """Return the quantities of which a statement needs other points."""
    return over_points(statement.value) if isinstance(statement, Assign) else set()


def _names(expression: Expression) -> set[str]:
    return {read.name for read in reads(expression)}


def reads(expression: Expression) -> Iterator[Read]:
    """Yield the quantities in an expression."""
    match expression:
        case Read():
            yield expression
        case OverPoints(value=value) | Former(value=value):
            yield value
        case Operation(operands=operands):
            for operand in operands:
                yield from reads(operand)


def _renamed(statement: Simple, names: dict[str, str]) -> Simple:
    """Return a statement that reads values at its own point under other names."""

    def value(expression: Expression) -> Expression:
        match expression:
            case Read(name=name, at=at) if name in names:
                return Read(names[name], at)
            case Operation(operator=operator, operands=operands):
                return Operation(operator, tuple(map(value, operands)))
        return expression

    if isinstance(statement, Assign):
        return replace(statement, value=value(statement.value))
    return replace(statement, argument=names.get(statement.argument, statement.argument))
