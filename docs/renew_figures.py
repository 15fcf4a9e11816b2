"""Draw the figures of the tutorials, as a reader gets them who copies the commands.

`python docs/renew_figures.py` carries out the blocks of the tutorials that `make test-all` does.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

DOCS = Path(__file__).parent
BLOCK = re.compile(r"^```(sh|toml)(?: file: (\S+))?\n(.*?)^```$", re.MULTILINE | re.DOTALL)
FIGURES = {
    "vo2": {"vo2-identified": "figures/preisach-nonmonotonic-loops.png"},
    "sma": {"sma-controlled": "recordings/*length-control*/report/signals.png"},
    "hybrid": {"hybrid-identified": "figures/prandtl-ishlinskii-loops.png"},
}
"""By tutorial, the figures of its page and the file that is each of them."""
COLORS = 64
"""Colours of a figure: lines and labels need no more, and the file has a third of the size."""


def main() -> None:
    """Carry the tutorials out, and keep their figures beside the pages."""
    environment = {**os.environ, "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])}
    for page, figures in FIGURES.items():
        with tempfile.TemporaryDirectory() as folder:
            for _, name, text in BLOCK.findall((DOCS / "tutorials" / f"{page}.md").read_text(encoding="utf-8")):
                if name:
                    (Path(folder) / name).write_text(text, encoding="utf-8")
                else:
                    subprocess.run(["sh", "-e", "-c", text], cwd=folder, env=environment, check=True)  # noqa: S603, S607
            for name, pattern in figures.items():
                (file,) = Path(folder).glob(pattern)
                with Image.open(file) as image:
                    image.convert("RGB").quantize(COLORS).save(DOCS / f"{name}.png", optimize=True)


if __name__ == "__main__":
    main()
