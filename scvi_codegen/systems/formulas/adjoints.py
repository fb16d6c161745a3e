"""Derivatives of straight-line programs: adjoints for one result, elimination of vertices for several.

The local derivatives of a program with intermediate quantities are the edges of a graph from variables to results. A
gradient follows from adjoints, from the last quantity to the first, in a small multiple of the operations of the
program (reverse accumulation). A Jacobian is what remains when all quantities are eliminated: each is replaced by the
products of the edges into and out of it. Eliminated from the leaves of a tree of bodies on, with respect to velocities,
these products are those of the composite rigid body algorithm, and the mass matrix of n bodies takes O(n^2) operations.

A. Griewank and A. Walther, Evaluating Derivatives, SIAM 2008, chapters 3 and 10.
"""

from collections.abc import Callable, Mapping
from heapq import heapify, heappop, heappush
from typing import TypeAlias

from sympy import Expr, S

from scvi_codegen.systems.formulas.intermediates import Intermediate, intermediate, product, total

Gradient: TypeAlias = dict[int | Intermediate, Expr]
"""Non-zero derivatives by the index of a variable, or by an intermediate quantity that depends on variables."""
Derived = Callable[[Expr], Gradient]
"""Derivatives of an expression, or of a definition, by the variables and quantities that occur in it."""


def gradient_by_adjoints(gradient: Gradient, derived: Derived) -> dict[int, Expr]:
    """Return the derivatives by variables of a result with the given local derivatives."""
    parts = {key: [entry] for key, entry in gradient.items()}
    pending = [(-key.number, key) for key in parts if isinstance(key, Intermediate)]
    heapify(pending)
    while pending:
        _, node = heappop(pending)
        adjoint = intermediate(total(parts.pop(node)))
        for key, derivative in derived(node.definition).items() if adjoint is not S.Zero else ():
            if isinstance(key, Intermediate) and key not in parts:
                heappush(pending, (-key.number, key))
            parts.setdefault(key, []).append(product(derivative, adjoint))
    entries = {index: total(terms) for index, terms in parts.items() if isinstance(index, int)}
    return {index: entry for index, entry in entries.items() if entry is not S.Zero}


class Elimination:
    """Jacobian of several results by elimination of the intermediate quantities between them and the variables.

    Quantities that precede only results with small indices, or depend only on variables with small indices, are
    eliminated last: in systems whose coordinates are in the order of a tree, these are the quantities near its root.
    Among the others, the cheapest is eliminated first (Markowitz).

    Args:
        rows: the results by index.
        derived: local derivatives.
        lower: only the lower triangle is required.
    """

    def __init__(self, rows: Mapping[int, Expr], derived: Derived, *, lower: bool) -> None:
        self.rows, self.lower = rows, lower
        self.parts: dict[int | Intermediate, dict[int | Intermediate, list[Expr]]] = {}
        self.users: dict[Intermediate, dict[int | Intermediate, None]] = {}
        pending: list[tuple[int | Intermediate, Expr]] = [*rows.items()]
        while pending:
            user, expression = pending.pop()
            self.parts[user] = {key: [entry] for key, entry in derived(expression).items()}
            for key in self.parts[user]:
                if isinstance(key, Intermediate):
                    if key not in self.users:
                        pending.append((key, key.definition))
                    self.users.setdefault(key, {})[user] = None
        self.last: dict[int | Intermediate, int] = {row: row for row in rows}
        ordered = sorted(self.users, key=lambda quantity: quantity.number)
        for node in reversed(ordered):
            self.last[node] = max(self.last[user] for user in self.users[node])
        first: dict[Intermediate, int] = {}
        for node in ordered:
            first[node] = max(first[key] if isinstance(key, Intermediate) else key for key in self.parts[node])
        self.level = {node: min(first[node], self.last[node]) for node in ordered}

    def jacobian(self) -> dict[tuple[int, int], Expr]:
        """Return the non-zero entries by (row, column)."""
        queue = [self._rank(node) for node in self.users]
        heapify(queue)
        while queue:
            entry = heappop(queue)
            node = entry[-1]
            if node in self.users and entry == self._rank(node):
                for changed in self._eliminate(node):
                    heappush(queue, self._rank(changed))
        entries = {(row, key): total(terms) for row in self.rows for key, terms in self.parts[row].items()}
        return {place: entry for place, entry in entries.items() if entry is not S.Zero}

    def _rank(self, node: Intermediate) -> tuple[int, int, int, Intermediate]:
        return (-self.level[node], len(self.parts[node]) * len(self.users[node]), -node.number, node)

    def _eliminate(self, node: Intermediate) -> list[Intermediate]:
        """Replace a quantity by products of derivatives; return the quantities whose edges changed."""
        inputs = {key: intermediate(total(terms)) for key, terms in self.parts.pop(node).items()}
        users = self.users.pop(node)
        for user in users:
            entry = intermediate(total(self.parts[user].pop(node)))
            for key, derivative in inputs.items():
                if self.lower and isinstance(key, int) and key > self.last[user]:
                    continue
                self.parts[user].setdefault(key, []).append(product(entry, derivative))
                if isinstance(key, Intermediate):
                    self.users[key][user] = None
        quantities = [key for key in inputs if isinstance(key, Intermediate)]
        for key in quantities:
            self.users[key].pop(node, None)
        return [*quantities, *(user for user in users if isinstance(user, Intermediate))]
