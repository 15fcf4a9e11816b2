"""The laboratories of the three rigs, with a record of the truth beside the run."""

from rigs.hybrid.laboratory import HybridLaboratory
from rigs.muscles.laboratory import SMALaboratory
from rigs.vo2.laboratory import VO2Laboratory

PERIOD = 0.05
"""Laboratory time between two looks at the truth, s."""

latest = []
"""The laboratory that was made last."""


class Observed:
    """Looks at the truth every period, at its instant."""

    def __init__(self, settings, clock, seed):
        super().__init__(settings, clock, seed)
        self.clock = clock
        self.seen = []
        latest[:] = [self]
        self._look()

    def _look(self):
        self.seen.append((self.world.time, {name: float(each.value) for name, each in self.truth().items()}))
        self.at(self.world.time + PERIOD, self._look)

    def outputs(self):
        """Return the outputs as they are now, by name."""
        self.world.advance()
        return {name: float(each.value) for name, each in self.truth().items() if each.is_output}


class VO2(Observed, VO2Laboratory):
    pass


class SMA(Observed, SMALaboratory):
    pass


class Hybrid(Observed, HybridLaboratory):
    pass
