"""Prototypes and optional fields of a C header, recorded while its template is rendered."""

from dataclasses import dataclass, field

from scvi_codegen.codegen.rendering.text import wrapped_prototype


@dataclass(frozen=True, slots=True)
class HeaderRecord:
    """What the template of one header declares.

    Attributes:
        prefix: of the exported names; real: C type of the numbers.
        functions: names of the exported functions, without the prefix.
        run_fields: fields of the struct of a run that not every integrator has.
    """

    prefix: str
    real: str
    functions: list[str] = field(default_factory=list)
    run_fields: list[str] = field(default_factory=list)

    def prototype(self, result: str, name: str, *arguments: str) -> str:
        """Return the declaration of ``<prefix>_<name>``; types may contain ``{prefix}`` and ``{real}``."""
        self.functions.append(name)
        between = "" if result.endswith("*") else " "
        head = f"{result}{between}{{prefix}}_{name}({', '.join(arguments) or 'void'});"
        return wrapped_prototype(head.format(prefix=self.prefix, real=self.real))

    def optional(self, name: str) -> str:
        """Return the name of a field of a run."""
        self.run_fields.append(name)
        return name
