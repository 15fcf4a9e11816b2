"""Labels of ticks."""

from matplotlib.ticker import ScalarFormatter


class PlainTicks(ScalarFormatter):
    """Labels of ticks as plain text, and the factor of an axis in mathematical type.

    A label looks the same in both, but to set it as an equation takes some 15 ms.
    """

    def __init__(self) -> None:
        super().__init__(useMathText=False)

    def get_offset(self) -> str:
        """Return the factor by which the labels of the axis are multiplied."""
        self.set_useMathText(True)
        try:
            return str(super().get_offset())
        finally:
            self.set_useMathText(False)
