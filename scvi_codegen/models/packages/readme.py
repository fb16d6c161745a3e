"""README of generated folders."""

from __future__ import annotations

from string import Template

from scvi_codegen.files.cache import template_folder
from scvi_codegen.rendering.program_source import Embedded
from scvi_codegen.rendering.source import Interface

CLOCK = """
Time is transformed: steps `h` are of tau, dt = g dtau and `t` is integrated along. The parameter
`${energy}` is the energy of the initial state; `main.c` shows how it is set.
"""

CONTROL = """By adaptive steps, each with a relative error of `tolerance` (0: round-off), to `t_end`:

```c
static ${prefix}_run run;
${prefix}_start(&run, t, 0.0, q0, p0);
int status = ${prefix}_advance_to(&run, t_end, tolerance, most_steps, most_steps, parameters, NULL, &t, q, p,
    &iterations, &report, workspace); /* there, if run.t == t_end and run.t_low == 0: the state is in run.q and run.p */
```
"""


DENSITY = """By steps of `tau` in a time with dt = g dtau, g = ${g}, the same forward and backward, to `t_end`:

```c
static ${prefix}_run run;
${prefix}_start(&run, t, 0.0, q0, p0);
int status = ${prefix}_advance_to(&run, t_end, tau, most_steps, most_steps, parameters, NULL, &t, q, p,
    &iterations, &report, workspace); /* there, if run.t == t_end and run.t_low == 0: the state is in run.q and run.p */
```
"""


INPUTS = """
Inputs ($inputs) are tables, `${prefix}_input` each. Steps end at their breakpoints; until `t_end`:

```c
for (long long steps; (steps = ${prefix}_next_steps(&run, t_end, h, inputs, parameters)) > 0;)
  status = ${prefix}_advance(&run, steps, save_every, parameters, NULL, t, q, p, iterations, &report, workspace);
```
"""


def _further(text: str, interface: Interface) -> str:
    """Return an optional part of the README."""
    inputs = ", ".join(f"`{name}`" for name in interface.inputs)
    return Template(text).substitute(prefix=interface.prefix, inputs=inputs, g=interface.time_transformation)


def readme_text(interface: Interface, *, with_model: bool, embedded: Embedded | None, controlled: bool) -> str:
    """Return the text of ``README.md``."""
    defaults = zip(interface.parameters, interface.defaults, strict=True)
    listed = ", ".join(f"`{name}` ({value!r})" for name, value in defaults)
    advance, to_end = (DENSITY, "h=tau, t_end=t_end") if interface.time_transformation else (CONTROL, "t_end=t_end")
    return (
        Template(package_template("README_embedded.md" if embedded else "README.md"))
        .substitute(
            real="float" if embedded == "single" else "double",
            prefix=interface.prefix,
            macro=interface.prefix.upper(),
            title=" ".join(interface.title.split()),
            notes=", ".join(interface.notes),
            coordinates=", ".join(f"`{name}`" for name in interface.coordinates),
            parameters=(f"Parameters, with default values: {listed}." if listed else "There are no parameters.")
            + Template(CLOCK if interface.energy_parameter else "").substitute(energy=interface.energy_parameter),
            control=_further(advance * controlled + INPUTS * bool(interface.inputs), interface),
            integrate=f"\ntrajectory = {interface.prefix}.stepper.integrate(q0, p0, {to_end})" if controlled else "",
            origin="`model.toml` is what it was generated from." if with_model else "",
        )
        .rstrip("\n")
        + "\n"
    )


def package_template(name: str) -> str:
    """Return a file of ``templates/package``."""
    return (template_folder() / "package" / name).read_text(encoding="utf-8")
