"""A functional mock-up unit as a plant: somebody else's simulated actuator, by FMPy."""

from __future__ import annotations

import math
import shutil
import tempfile
import weakref
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bench.base import ConfigurationError, needed_for

_ON_TIME = 5e-7
"""Time before which a step counts as complete, s. Source: microseconds are the shortest that a world passes."""


class FMUPlant:
    """A unit for co-simulation of FMI 2.0 or 3.0 on a grid of time, however calls divide the time.

    A set-point acts from the next step of the grid on. A unit is a program that runs in this process.

    Parameters
    ----------
    path : Path
        The `.fmu` file.
    takes : str
        Input of the unit that takes set-points.
    gives : sequence of str
        Outputs of the unit, whose values `outputs` holds.
    step : float
        Step of the grid, s.
    initial : float
        Set-point at the beginning.

    Raises
    ------
    ConfigurationError
        If the file cannot be read or is no such unit, a variable is missing, or a step fails.
    """

    def __init__(self, path: Path, takes: str, gives: Sequence[str], step: float, initial: float) -> None:
        with needed_for("an FMU as a plant", "fmu"):
            import fmpy
        self._path, self._step = path, step
        try:
            description = fmpy.read_model_description(str(path))
        except (OSError, zipfile.BadZipFile, KeyError) as error:
            raise ConfigurationError(f"the FMU {path} cannot be read: {error}") from None
        # The library's errors have no class of their own.
        except Exception as error:
            raise ConfigurationError(f"the FMU {path} is damaged: {error}") from None
        if description.coSimulation is None:
            raise ConfigurationError(f"the FMU {path} is not for co-simulation; export it for that")
        known = {each.name: each for each in description.modelVariables}
        for name, causality in [(takes, "input"), *((each, "output") for each in gives)]:
            if name not in known or known[name].causality != causality:
                there = ", ".join(each.name for each in description.modelVariables if each.causality == causality)
                raise ConfigurationError(f"the FMU {path} has no {causality} {name!r}; there are: {there or 'none'}")
        folder = tempfile.mkdtemp()
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        fmpy.extract(str(path), unzipdir=folder)
        self._unit: Any = fmpy.instantiate_fmu(folder, description, "CoSimulation")
        is_second = description.fmiVersion.startswith("2")
        self._set = self._unit.setReal if is_second else self._unit.setFloat64
        self._get = self._unit.getReal if is_second else self._unit.getFloat64
        self._takes = [known[takes].valueReference]
        self._gives = [known[name].valueReference for name in gives]
        if is_second:
            self._unit.setupExperiment(startTime=0.0)
        self._unit.enterInitializationMode()
        self._set(self._takes, [initial])
        self._unit.exitInitializationMode()
        self._time, self._taken, self._setpoint = 0.0, 0, initial
        self.outputs: list[float] = list(self._get(self._gives))

    def set(self, value: float) -> None:
        """Take a set-point."""
        self._setpoint = value

    def advance(self, dt: float) -> None:
        """Let `dt` seconds pass."""
        self._time += dt
        whole = math.floor((self._time + _ON_TIME) / self._step)
        if self._taken >= whole:
            return
        self._set(self._takes, [self._setpoint])
        try:
            for step in range(self._taken, whole):
                self._unit.doStep(currentCommunicationPoint=step * self._step, communicationStepSize=self._step)
        # The library's errors have no class of their own.
        except Exception as error:
            raise ConfigurationError(f"the FMU {self._path} failed at {step * self._step:g} s: {error}") from None
        self._taken = whole
        self.outputs = list(self._get(self._gives))
