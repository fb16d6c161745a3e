"""Which tests stand next to a file, those that a fault in it is shown to."""

from __future__ import annotations

from pathlib import Path

from checkout import ROOT

__all__ = ["NEAR", "near"]

NEAR: dict[str, tuple[str, ...]] = {
    "templates/support/indexed": (
        "runtime/test_indexed.py",
        "runtime/test_indexed_scales.py",
        "runtime/test_indexed_newton.py",
        "runtime/test_indexed_runs.py",
        "runtime/test_low_words.py",
        "verification/test_indexed.py",
        "rendering/test_indexed.py",
    ),
    "templates/indexed": ("runtime/test_indexed.py", "rendering/test_indexed.py"),
    "templates/main": ("models/test_package.py",),
    "templates/parts/main": ("models/test_package_inputs.py",),
    "templates/support/density": ("runtime/test_density.py", "runtime/test_low_words.py"),
    "templates/support/hamiltonian_iteration": (
        "mechanics/test_hamiltonian.py",
        "lowering/test_iterations.py",
        "lowering/test_sweeps.py",
        "rendering/test_c_text.py",
        "promises/test_matrix.py",
    ),
    "templates/support/run.h": (
        "runtime/test_stepper.py",
        "lowering/test_newton.py",
        "runtime/test_low_words.py",
        "promises/test_matrix.py",
    ),
    "templates/support/exchanges": ("runtime/test_exchanges.py", "promises/test_forced_motion.py"),
    "templates/support/inputs": ("runtime/test_driven.py", "models/test_package_inputs.py"),
    "templates/support/push": (
        "runtime/test_sensitivity.py",
        "runtime/test_deviations.py",
        "rendering/test_support.py",
    ),
    **{
        f"templates/support/{stem}": ("runtime/test_swept_derivatives.py", "runtime/test_sensitivity.py")
        for stem in (
            "vectors_by_iteration",
            "carry_by",
            "changes_at",
            "coupled_derivatives",
            "separable_derivatives",
            "vectors_step_by_step",
        )
    },
    "scvi_codegen/lowering/swept": ("runtime/test_swept_derivatives.py",),
    "templates/support/linear": ("runtime/test_sensitivity.py", "rendering/test_derivatives_text.py"),
    "templates/support/flow": (
        "frameworks/test_flow_entries.py",
        "promises/test_matrix.py",
        "frameworks/test_casadi.py",
        "rendering/test_flow_text.py",
    ),
    "templates/support/casadi": (
        "frameworks/test_flow_entries.py",
        "frameworks/test_casadi.py",
        "rendering/test_flow_text.py",
    ),
    "templates/support/xla": (
        "frameworks/test_flow_entries.py",
        "frameworks/test_jax.py",
        "rendering/test_flow_text.py",
    ),
    "templates/support/float": ("rendering/test_c_text.py",),
    "templates/support/newton_fallback": ("runtime/test_fallback.py", "lowering/test_iterations.py"),
    "scvi_codegen/runtime/observation": ("runtime/test_stalling.py", "runtime/test_events.py"),
    "templates/support/lent": ("runtime/test_fallback.py",),
    "templates/support/borrowed": ("runtime/test_fallback.py",),
    "templates/support/strays": ("runtime/test_fallback.py", "runtime/test_longest_step.py"),
    "templates/support/events": ("runtime/test_events.py", "rendering/test_support.py"),
    "templates/support/event_": ("runtime/test_events.py", "runtime/test_clock.py"),
    "templates/support/legendre": (
        "runtime/test_given_velocities.py",
        "runtime/test_stepper.py",
        "rendering/test_c_text.py",
    ),
    "templates/parts/newton": (
        "lowering/test_iterations.py",
        "lowering/test_newton.py",
        "runtime/test_sensitivity.py",
        "runtime/test_stepper.py",
        "methods/test_constraints.py",
    ),
    "templates/support/newton": (
        "lowering/test_iterations.py",
        "lowering/test_newton.py",
        "lowering/test_stiff_newton.py",
        "rendering/test_support.py",
    ),
    "templates/support/band": ("lowering/test_band.py", "lowering/test_newton.py"),
    "templates/support/crowd": ("runtime/test_ensemble.py", "runtime/test_low_words.py"),
    "templates/support/many": ("runtime/test_ensemble.py",),
    "templates/support/trajectories": ("runtime/test_ensemble.py", "runtime/test_drift.py"),
    **{
        f"templates/support/{stem}": (
            "runtime/test_controlled_steps.py",
            "lowering/test_ladder.py",
            "rendering/test_support.py",
            "runtime/test_step_error.py",
            "results/test_controlled_recording.py",
        )
        for stem in (
            "advance_to",
            "control",
            "curve",
            "ladder",
            "observed",
            "levels",
            "stage_error",
            "iteration_error",
            "sweep_or",
            "trial",
        )
    },
    **{
        f"templates/support/{stem}": ("runtime/test_clock.py", "mechanics/test_transformed_time.py")
        for stem in ("clock", "even_time", "part_of_step", "integrals", "hamiltonian_integrals", "coupled_integrals")
    },
    **{
        f"templates/support/{stem}": (
            "methods/test_constraints.py",
            "methods/test_joints.py",
            "methods/test_rolling.py",
            "runtime/test_low_words.py",
        )
        for stem in ("constraints", "rattle")
    },
    **{
        f"templates/support/{stem}": ("promises/test_damping.py", "promises/test_forced_motion.py")
        for stem in ("damping", "damped")
    },
    **{
        f"templates/support/{stem}": ("runtime/test_hessians.py", "rendering/test_derivatives_text.py")
        for stem in ("second_derivatives", "rows_")
    },
    **{
        f"templates/support/{stem}": (
            "runtime/test_stepper.py",
            "promises/test_identities.py",
            "promises/test_structure.py",
        )
        for stem in ("discrete_legendre", "ends_by", "explicit_legendre", "energies", "lagrangian", "momentum_maps")
    },
    **{
        f"templates/support/{stem}": ("runtime/test_indexed_waves.py", "runtime/test_indexed_newton.py")
        for stem in ("gmres", "fourier_preconditioner", "lattice_", "linear_vectors")
    },
    "templates/support/fmu": ("models/test_fmu.py",),
    "templates/fmu": ("models/test_fmu.py",),
    "templates/support/splitting": ("methods/test_composition.py", "runtime/test_drift.py", "runtime/test_ensemble.py"),
    "templates/support/drift_by": ("methods/test_composition.py", "runtime/test_drift.py", "runtime/test_ensemble.py"),
    "templates/parts/splitting": ("methods/test_composition.py", "runtime/test_drift.py", "runtime/test_ensemble.py"),
    "templates/": (
        "lowering/test_iterations.py",
        "lowering/test_sweeps.py",
        "lowering/test_contraction.py",
        "runtime/test_quantities.py",
        "lowering/test_collocation_solver.py",
        "runtime/test_stepper.py",
        "runtime/test_drift.py",
        "runtime/test_low_words.py",
        "promises/test_matrix.py",
    ),
    "scvi_codegen/ir": ("lowering/test_lowering.py", "lowering/test_rounding.py", "rendering/test_generated.py"),
    "scvi_codegen/lowering": ("lowering", "rendering/test_generated.py"),
    "scvi_codegen/rendering": (
        "rendering/test_generated.py",
        "rendering/test_written_out.py",
        "rendering/test_c_text.py",
    ),
    "scvi_codegen/methods": (
        "methods",
        "promises/test_identities.py",
        "promises/test_order.py",
        "display",
        "mechanics",
    ),
    "scvi_codegen/runtime": (
        "runtime/test_quantities.py",
        "runtime/test_stepper.py",
        "runtime/test_times.py",
        "runtime/test_dense_output.py",
        "runtime/test_events.py",
        "runtime/test_ensemble.py",
        "runtime/test_controlled_steps.py",
        "runtime/test_clock.py",
        "runtime/test_distributed.py",
        "promises/test_matrix.py",
    ),
    "scvi_codegen/runtime/indexed": (
        "runtime/test_indexed.py",
        "runtime/test_indexed_runs.py",
        "models/test_indexed_model_file.py",
    ),
    **{
        f"scvi_codegen/runtime/{stem}": ("runtime/test_fitting.py",) for stem in ("measurements", "fitting", "segments")
    },
    **{
        f"scvi_codegen/runtime/{stem}": ("runtime/test_exchanges.py", "runtime/test_step_error.py")
        for stem in ("recomputed_steps", "accuracy")
    },
    **{
        f"scvi_codegen/runtime/{stem}": ("runtime/test_deviations.py", "runtime/test_tangents.py")
        for stem in ("changes_in_lanes", "spreading", "nearby", "growth", "deviations")
    },
    **{
        f"scvi_codegen/runtime/{stem}": ("runtime/test_sensitivity.py", "runtime/test_periodic.py")
        for stem in ("gradients", "linearised", "compiled_method", "periodic")
    },
    "scvi_codegen/runtime/driven": ("runtime/test_driven.py", "runtime/test_driven_ensemble.py"),
    "scvi_codegen/runtime/longest": ("runtime/test_longest_step.py",),
    "scvi_codegen/runtime/constrain": ("methods/test_constraints.py", "methods/test_rolling.py"),
    "scvi_codegen/lowering/indexed": (
        "lowering/test_indexed_sums.py",
        "runtime/test_indexed.py",
        "runtime/test_indexed_runs.py",
    ),
    "scvi_codegen/rendering/indexed": ("rendering/test_indexed.py", "runtime/test_indexed.py"),
    "scvi_codegen/mechanics/indexed": ("mechanics/test_indexed.py", "runtime/test_indexed.py"),
    "scvi_codegen/formulas/indexed": (
        "formulas/test_indexed.py",
        "mechanics/test_indexed.py",
        "runtime/test_indexed.py",
        "derivation",
    ),
    "scvi_codegen/native": ("native",),
    "scvi_codegen/mechanics": ("mechanics",),
    "scvi_codegen/files": ("files", "results/test_recording.py", "results/test_ensemble_files.py"),
    "scvi_codegen/formulas": (
        "formulas/test_derivatives.py",
        "formulas/test_expression_text.py",
        "mechanics/test_system.py",
    ),
    "scvi_codegen/tables": ("tables",),
    "scvi_codegen/advice": ("advice", "cli/test_json.py", "cli/test_cli.py"),
    "scvi_codegen/cli": ("cli", "promises/test_first_mistakes.py"),
    "scvi_codegen/derivation": ("derivation",),
    "scvi_codegen/exact": ("exact", "verification/test_certificate.py"),
    "scvi_codegen/models": ("models", "cli/test_cli.py", "promises/test_versions.py"),
    "scvi_codegen/results": ("results", "cli/test_json.py"),
}
"""By the beginning of paths; the longest that fits counts."""


def near(path: str) -> list[str]:
    """Test files: that of its name, and those of the longest beginning of its path."""
    key = max((key for key in NEAR if path.startswith(key)), key=len)
    own = sorted(str(found.relative_to(ROOT)) for found in ROOT.glob(f"tests/*/test_{Path(path).stem}.py"))
    return list(dict.fromkeys([*own, *(f"tests/{name}" for name in NEAR[key])]))
