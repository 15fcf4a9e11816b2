"""The emulated laboratory: the rod, its coil source and its strain bridge on the clock of the run."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from bench.base import Clock
from bench.rig import LaboratorySettings
from magnetostrictive_rod.instruments import EmulatedCoilSource, EmulatedStrainBridge
from magnetostrictive_rod.plant import MagnetostrictiveRod, RodParameters
from sim_devices.laboratory import EmulatedLaboratory, TrueValue
from sim_devices.world import World


class RodLaboratory(EmulatedLaboratory):
    """The laboratory with the instruments `coil` and `bridge`, both on serial lines; all noise comes from `seed`."""

    class Settings(LaboratorySettings):
        """Keys of the table `[emulation]`."""

        noise: float = Field(default=1e-6, ge=0, le=1, description="noise of each bridge voltage, V rms")

    def __init__(self, settings: Settings, clock: Clock, seed: int) -> None:
        # One stream an instrument: how often one is read must not change the readings of the other.
        coil_stream, bridge_stream = np.random.default_rng(seed).spawn(2)
        self.rod = MagnetostrictiveRod(RodParameters())
        world = World(self.rod, clock)
        self.coil = EmulatedCoilSource(world, self.rod, coil_stream)
        self.bridge = EmulatedStrainBridge(world, self.rod, settings.noise, bridge_stream)
        super().__init__("rod laboratory", {"coil": self.coil, "bridge": self.bridge}, clock, world=world, seed=seed)

    def truth(self) -> dict[str, TrueValue]:
        """Return the state of the rod and of the coil source, for `bench rig emulate`."""
        return {
            "coil_current": TrueValue(self.rod.current, "A"),
            "coil_output": TrueValue(self.coil.on, is_output=True),
            "strain": TrueValue(sum(self.rod.strains) / 2),
        }
