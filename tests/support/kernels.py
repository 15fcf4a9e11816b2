"""The packages with kernels. As a script: compile all kernels, before the tests would do it in each worker."""

from pathlib import Path

ROOT = Path(__file__).parents[2]
OWN = sorted(
    {
        ".".join(file.relative_to(ROOT).parent.parts)
        for folder in ("bench", "rigs", "sim_devices")
        for file in (ROOT / folder).rglob("*_kernels.py")
    }
)

if __name__ == "__main__":
    from rich.console import Console

    from bench.base import compile_kernels

    compile_kernels(OWN, Console(stderr=True))
