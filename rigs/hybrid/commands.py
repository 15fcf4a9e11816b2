"""Commands of the hybrid."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from bench.base import print_plain
from bench.cli import JsonOption, console, print_rows, write_json


def identify(
    steps: Annotated[Path, typer.Argument(metavar="STEPS_RUN", help="A run of current-steps.")],
    static: Annotated[Path, typer.Argument(metavar="STATIC_RUN", help="A run of thermomechanical.")],
    loops: Annotated[Path, typer.Argument(metavar="LOOPS_RUN", help="A run of piezo-loops.")],
    step: Annotated[Path, typer.Argument(metavar="STEP_RUN", help="A run of piezo-step.")],
    plays: Annotated[int, typer.Option(min=1, max=200, help="Number of play operators.")] = 15,
    out: Annotated[Path | None, typer.Option(metavar="model.json", help="Where the model file goes.")] = None,
    json_file: JsonOption = None,
) -> None:
    """Identify the model of a thermo-piezoelectric hybrid, each part from the run that characterized it.

    Thermal network from the steps of the current, polynomial from the static curve, plays from the slow loops of the
    voltage, third-order dynamics from the fast step.
    """
    from rigs.hybrid.identification import hybrid_file, identify_hybrid

    found = identify_hybrid(steps, static, loops, step, plays=plays)
    network, dynamics, piezo = found.network, found.dynamics, found.piezo.errors
    fitted = ((name, value) for name, value in network.uncertainties.items() if name != "ambient")
    rows = [
        ("network, RMS of base and tip", f"{network.base.rms:.3f} and {network.tip.rms:.3f} K"),
        *((name, f"{getattr(network.network, name):.4g} ± {uncertainty:.2g}") for name, uncertainty in fitted),
        (f"polynomial of order {found.order.order}, RMS", f"{found.polynomial.errors.rms * 1e6:.3f} µm"),
        (f"{plays} plays, RMS", f"{piezo.rms_percent:.2f} % of {piezo.span * 1e6:.1f} µm"),
        *(
            (
                name.replace("_", " "),
                f"{getattr(dynamics.model, name):.5g} ± {dynamics.uncertainties[name]:.2g} {unit}",
            )
            for name, unit in (("real_pole", "rad/s"), ("frequency", "rad/s"), ("damping", ""))
        ),
    ]
    print_rows("hybrid", rows)
    if out is not None:
        hybrid_file(found, (steps, static, loops, step)).save(out)
        print_plain(console, f"model: {out}")
    write_json(
        json_file,
        {
            "network_rms_K": {"base": network.base.rms, "tip": network.tip.rms},
            "polynomial_order": found.order.order,
            "polynomial_rms_um": found.polynomial.errors.rms * 1e6,
            "prandtl_ishlinskii_rms_percent": piezo.rms_percent,
            "poles_rad_s": {"real": dynamics.model.real_pole, "resonance": dynamics.model.frequency},
            "damping": dynamics.model.damping,
        },
    )
