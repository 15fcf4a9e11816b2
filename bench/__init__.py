"""A lab bench for smart-material actuators.

What scripts and notebooks need::

    import bench

    run = bench.run("damped-oscillation", rig="my-rig.toml")
    model = bench.identify(run, "preisach", levels=20)
    setpoints = bench.invert(model, [500.0, 900.0]).setpoints

All functions are documented in `bench.api`; each is imported when it is first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from bench.api import compare, deploy, identify, invert, load, open_rig, predict, rehearse, report, run, runs

__all__ = [
    "compare", "deploy", "identify", "invert", "load", "open_rig", "predict", "rehearse", "report", "run", "runs",
]  # fmt: skip


def __getattr__(name: str) -> Any:  # noqa: ANN401 - any of the names above
    if name == "__version__":
        # Reading it takes a while.
        from importlib.metadata import version

        return version("actuator-bench")
    if name not in __all__:
        raise AttributeError(f"module 'bench' has no attribute {name!r}")
    from bench import api

    return getattr(api, name)


def __dir__() -> list[str]:
    return __all__
