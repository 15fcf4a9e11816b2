"""A figure for notebooks."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, repr=False)
class Picture:
    """A figure that a notebook shows.

    Attributes
    ----------
    png : bytes
        The figure.
    """

    png: bytes

    @classmethod
    def drawn_by(cls, draw: Callable[[Path], Path]) -> Picture:
        """Return what a function draws in a folder, of which it returns the file."""
        with tempfile.TemporaryDirectory() as folder:
            return cls(draw(Path(folder)).read_bytes())

    def save(self, path: str | Path) -> None:
        """Write the figure as a PNG file."""
        Path(path).write_bytes(self.png)

    def _repr_png_(self) -> bytes:
        return self.png
