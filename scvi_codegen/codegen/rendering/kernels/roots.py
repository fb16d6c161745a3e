"""Products with inverse roots for vectors, with a shorter chain of dependent operations.

AVX-512 estimates y = x^(-1/2) and corrects the power y^k by a series. A product of the root and other factors waits for
the series and then for each factor. If the factors multiply y^k instead, only the correction waits for the series. That
costs an operation for each product, and pays off in kernels of few operations, whose time is their latency.
"""

from collections import Counter
from dataclasses import replace
from typing import NamedTuple

from scvi_codegen.codegen.ir.kernel import Constant, Expression, Kernel, Load, Operation, subexpressions
from scvi_codegen.codegen.rendering.kernels.printer import INVERSE_ROOT, TIMES

MOST_ROOTS, MOST_PRODUCTS = 1, 3
"""Largest numbers of roots in a kernel, and of products with them."""


class _Product(NamedTuple):
    """Root of the argument times a factor."""

    root: str
    argument: Expression
    factor: Expression | None


def with_factors_in_roots(kernel: Kernel) -> Kernel:
    """Return the kernel with products of a root as ``inverse_root_k_times(x, factor)``, if they are few."""
    rewritten = _Rewriting(kernel).kernel()
    roots = _roots(kernel)
    products = Counter(root.operator.endswith(TIMES) for root in _roots(rewritten))
    few = 0 < len(roots) <= MOST_ROOTS and not products[False] and products[True] <= MOST_PRODUCTS
    return rewritten if few and not kernel.sums else kernel


def _roots(kernel: Kernel) -> list[Operation]:
    """Return the inverse roots of a kernel, with or without a factor."""
    operations = (x for x in subexpressions(*kernel.temporaries, *kernel.results) if isinstance(x, Operation))
    return [operation for operation in operations if operation.operator.startswith(INVERSE_ROOT)]


class _Rewriting:
    """Kernel whose temporaries that are products with a root are parts of the products that use them."""

    def __init__(self, kernel: Kernel) -> None:
        self.original = kernel
        self.temporaries: list[Expression] = []
        self.loads: dict[int, Expression] = {}
        self.products: dict[int, _Product] = {}

    def kernel(self) -> Kernel:
        for k, expression in enumerate(self.original.temporaries):
            product = self.product(expression)
            if product is None:
                self.loads[k] = self.temporary(self.rewritten(expression))
            else:
                self.products[k] = product
        results = tuple(map(self.rewritten, self.original.results))
        return replace(self.original, temporaries=tuple(self.temporaries), results=results)

    def temporary(self, expression: Expression) -> Expression:
        """Return a load of a new temporary."""
        self.temporaries.append(expression)
        return Load("w", len(self.temporaries) - 1)

    def product(self, expression: Expression) -> _Product | None:
        """Return an expression as a product with exactly one root, ``None`` if it is none."""
        if isinstance(expression, Load):
            return self.products.get(expression.index) if expression.source == "w" else None
        if not isinstance(expression, Operation):
            return None
        if expression.operator.startswith(INVERSE_ROOT):
            argument = self.rewritten(expression.operands[0])
            return _Product(
                expression.operator, argument if isinstance(argument, Load) else self.temporary(argument), None
            )
        if expression.operator not in ("neg", "*"):
            return None
        products = [(operand, self.product(operand)) for operand in expression.operands]
        with_root = [product for _, product in products if product is not None]
        if len(with_root) != 1:
            return None
        product, factor = with_root[0], with_root[0].factor
        if expression.operator == "neg":  # -(r f) = r (-f)
            return product._replace(factor=Operation("neg", (factor or Constant(1),)))
        other = next(self.rewritten(operand) for operand, within in products if within is None)
        # (r f) g = r (f g)
        return product._replace(factor=Operation("*", (factor, other)) if factor else other)

    def rewritten(self, expression: Expression) -> Expression:
        product = self.product(expression)
        if product is not None:
            root, argument, factor = product
            return Operation(f"{root}{TIMES}", (argument, factor)) if factor else Operation(root, (argument,))
        if isinstance(expression, Load):
            return self.loads[expression.index] if expression.source == "w" else expression
        if isinstance(expression, Operation):
            return replace(expression, operands=tuple(map(self.rewritten, expression.operands)))
        return expression
