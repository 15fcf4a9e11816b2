"""What the dashboard shows of a protocol: loops of its slots, their plane, and slots over time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from bench.rig import DashboardLayout, Range, Slot, Slots, XYPlot

_ROOM = 0.05
"""Part of a slot's range that an axis shows beyond either end."""


@dataclass(frozen=True)
class Views:
    """What is worth seeing of a protocol, by slots; a slot that the rig does not bind is left out.

    Attributes
    ----------
    loops : tuple of (str, str)
        Slots of input and output that are plotted over each other; the first input drives the memory curve.
    plane : bool
        Whether the Preisach plane of the first input is shown.
    over_time : tuple of str
        Slots whose plots over time are always visible; the others are in tabs. All of them if empty.
    """

    loops: tuple[tuple[str, str], ...] = ()
    plane: bool = True
    over_time: tuple[str, ...] = ()

    def signals_over_time(self, slots: Slots) -> list[str]:
        """Return the signals that are always visible over time."""
        return [slots[name].signal for name in self.over_time if name in slots]

    def layout(self, slots: Slots, of_rig: DashboardLayout | None) -> DashboardLayout | None:
        """Return the layout of a run, with ranges of the slots or else of the rig's layout; None without a loop."""
        plots = list(self._plots(slots, of_rig))
        if not plots:
            return None
        first = plots[0]
        plane: Range | None = None
        if self.plane:
            known = of_rig.plane if of_rig is not None and first.input == of_rig.input else None
            plane = known or next(slot.table.range for slot in slots.values() if slot.signal == first.input)
        return DashboardLayout(
            **first.model_dump(),
            plane=plane,
            levels=of_rig.levels if of_rig is not None else DashboardLayout.model_fields["levels"].default,
            loops=tuple(plots[1:]),
        )

    def _plots(self, slots: Slots, of_rig: DashboardLayout | None) -> Iterator[XYPlot]:
        ranges = {} if of_rig is None else of_rig.ranges

        def range_of(slot: Slot) -> Range | None:
            if slot.table.range is None:
                return ranges.get(slot.signal)
            low, high = slot.table.range
            room = _ROOM * (high - low)
            return low - room, high + room

        for pair in self.loops:
            if all(name in slots for name in pair):
                x, y = (slots[name] for name in pair)
                x_range, y_range = range_of(x), range_of(y)
                if x_range is not None and y_range is not None:
                    yield XYPlot(input=x.signal, output=y.signal, input_range=x_range, output_range=y_range)
