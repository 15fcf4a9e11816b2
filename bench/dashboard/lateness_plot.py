"""How late the samples of the loops were, as bars: the histograms that are kept with a run on the wall clock."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import rerun as rr
import rerun.blueprint as rrb

from bench.dashboard.drawing import INK, MARKER, lines, texts
from bench.dashboard.rerun_recording import RerunRecording
from bench.record import bins_of, headline_of

_PATH = "lateness"
_ROW = 0.04
_HALF_WIDTH = 0.012
"""Height of a row, and half the width of a bar, where the longest bar has a length of 1.

Derivation: 25 rows are a square; a bar fills 60 % of its row.
"""
_NAMES, _COUNTS, _RAISED = -0.14, 0.08, 0.8
"""Where the names of the bins stand, the counts beside the ends of their bars, and both above theirs, in rows.

Derivation: within the view, which is from −0.3 to 1.3 wide; texts hang from their places.
"""


class LatenessPlot:
    """Draws the histograms of the loops of a run, one below the other.

    On a virtual clock no time passes while a sample is taken, and nothing is drawn.
    """

    def __init__(self, meta: Mapping[str, Any]) -> None:
        self._is_drawn = meta.get("clock", "virtual") != "virtual"
        self._rows = 0

    def draw(self, recording: RerunRecording, recorded: Mapping[str, Mapping[str, Any]]) -> None:
        """Draw the histograms by the label of the loop, see `Lateness.to_json`; nothing if there are none."""
        if not (self._is_drawn and recorded):
            return
        bars, ends, names, counts, heads = [], [], [], [], []
        for label, each in recorded.items():
            heads.append(((0.5, (self._rows - 0.5) * _ROW), headline_of(label, each)))
            self._rows += 1
            found = bins_of(each)
            most = max(count for _, count in found)
            for name, count in found:
                y = (self._rows + 0.5) * _ROW
                length = count / most if most else 0.0
                names.append(((_NAMES, y - _RAISED * _ROW), name))
                counts.append(((length + _COUNTS, y - _RAISED * _ROW), str(count)))
                if count:
                    bars.append([(0.0, y), (length, y)])
                ends.append(y)
                self._rows += 1
            self._rows += 1
        recording.log(f"{_PATH}/axis", lines([[(0.0, ends[0] - _ROW), (0.0, ends[-1] + _ROW / 2)]], INK, 0.75, 10.0))
        recording.log(f"{_PATH}/bars", rr.LineStrips2D(bars, colors=MARKER, radii=_HALF_WIDTH))
        for kind, labelled in (("heads", heads), ("names", names), ("counts", counts)):
            recording.log(f"{_PATH}/{kind}", texts([place for place, _ in labelled], [text for _, text in labelled]))

    def view(self) -> rrb.Spatial2DView | None:
        """Return the view, None if there is nothing to see."""
        if not self._rows:
            return None
        bounds = rrb.VisualBounds2D(x_range=(-0.3, 1.3), y_range=(-1.5 * _ROW, max(self._rows, 6) * _ROW))
        return rrb.Spatial2DView(origin=f"/{_PATH}", name="Lateness of the loop", visual_bounds=bounds)
