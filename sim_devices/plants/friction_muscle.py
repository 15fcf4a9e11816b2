"""The common part of the braided pneumatic and the coiled polymer muscle: friction, equilibrium and time.

The compiled loops are in `_friction_kernels`, in mm, N, bar and °C; `FrictionParameters` and the commands and outputs
of the muscles are in SI units.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from bench.base import DeferredModule
from sim_devices.plants.grid import Floats, NotNegative, Record, fluctuation
from sim_devices.plants.muscle import MILLIMETRE, Muscle, MuscleParameters

if TYPE_CHECKING:
    from sim_devices.plants import _friction_kernels as kernels
else:
    kernels = DeferredModule("sim_devices.plants._friction_kernels")


@dataclass(frozen=True, kw_only=True)
class FrictionParameters(MuscleParameters):
    """Numbers that both muscles have."""

    contact_count: int = 40
    """Number of dry contacts, at least 1."""
    contact_stiffness: float
    """Stiffness of all contacts together before any has slipped, N/m."""
    contact_spread: NotNegative
    """Standard deviation of the logarithm of a contact's share of the yield force."""
    force_limit: float
    """Largest load, N."""
    force_step: float = 0.1
    """Largest sub-step of the force, N."""

    @property
    def largest_load(self) -> float:
        """Largest load, N."""
        return self.force_limit


def contact_table(parameters: FrictionParameters) -> Floats:
    """Make the specimen: the properties of its contacts.

    Returns
    -------
    ndarray
        One column a contact. Rows: stiffness (N/mm), share of the yield force (the sum is 1, lognormal), and how
        much of the free displacement the contact sees (uniform in 0 to 2, 1 on average).
    """
    p = parameters
    rng = np.random.default_rng(p.specimen_seed)
    weight = np.exp(p.contact_spread * rng.standard_normal(p.contact_count))
    share = rng.uniform(0.0, 2.0, p.contact_count)
    stiffness = np.full(p.contact_count, p.contact_stiffness * MILLIMETRE / p.contact_count)
    return np.array([stiffness, weight / weight.sum(), share / share.mean()])


def coefficients(parameters: FrictionParameters, deviation: float, time: float, **own: float) -> Record:
    """Prepare the coefficients of the compiled loops.

    Parameters
    ----------
    deviation, time : float
        Standard deviation (bar or K) and correlation time (s) of supply or room.
    **own : float
        Coefficients of this kind of muscle by name; those that are left out are zero.

    Returns
    -------
    record
        `COEFFICIENTS`.
    """
    p = parameters
    record = np.zeros(1, kernels.COEFFICIENTS)[0]
    decay, kick = fluctuation(deviation, time, p.step)
    values = {
        "step": p.step,
        "rest_length": p.rest_length / MILLIMETRE,
        "series_compliance": 1.0 / (p.series_stiffness * MILLIMETRE),
        "force_limit": p.force_limit,
        "force_step": p.force_step,
        "length_step": p.length_step / MILLIMETRE,
        "arm_time": 1.0,
        "offset_decay": decay,
        "offset_kick": kick,
    }
    for name, value in (values | own).items():
        record[name] = value
    return record


F = TypeVar("F", bound=FrictionParameters)


class FrictionMuscle(Muscle[F]):
    """A muscle with dry contacts, driven by pressure or temperature, that carries a load or is held.

    Each contact is a spring behind a slider (Iwan, Journal of Applied Mechanics 33, 1966): its force follows the
    motion that it sees, which is the elongation minus its own share of the drive's free displacement, and is
    limited by its share of the yield force of the moment. As that yield force changes with drive, load and length,
    the loops depend on all of them.

    Parameters
    ----------
    coefficients : record
        Coefficients of the compiled loops.
    cold, rated : float
        Drive at 0 V and at the rated voltage: bar or °C.
    """

    def __init__(
        self,
        parameters: F,
        coefficients: Record,
        cold: float,
        rated: float,
        rng: np.random.Generator,
    ) -> None:
        super().__init__(parameters, rng)
        self._coefficients = coefficients
        self._state = np.zeros(1, kernels.STATE)[0]
        self._parts = kernels.Parts(
            self._state,
            np.zeros(1, kernels.LAW)[0],
            coefficients,
            contact_table(parameters),
            np.zeros(parameters.contact_count),
        )
        self._condition(parameters.pretension, cold, rated)
        self._keep_first_force()

    @property
    def force(self) -> float:
        """Tension of the muscle, N."""
        return float(self._state["force"])

    @property
    def length(self) -> float:
        """Elongation of the muscle from its resting length, m; contraction is negative.

        A slack muscle has the length that it has without tension.
        """
        return float((self._state["length"] - self._coefficients["rest"]) * MILLIMETRE)

    @property
    def position(self) -> float:
        """Position of the moving end, m: elongation of muscle, frame and load cell; a servo imposes it."""
        return float(self._state["position"] * MILLIMETRE)

    def _take_steps(self, normals: Floats) -> None:
        kernels.advance_steps(normals, self._command, self.forces, self._parts)

    def _drive(self, drive: float, *, clamped: bool) -> None:
        """Move pressure or temperature so slowly that the Maxwell arm has no part in it."""
        kernels.drive_to(drive, 1e6 * float(self._coefficients["arm_time"]), clamped, self._parts)

    def _load(self, newton: float) -> None:
        kernels.load_to(newton, self._parts)

    def _condition(self, pretension: float, cold: float, rated: float) -> None:
        """Train the muscle and find its resting length, outside time."""
        self._state["drive"] = cold
        kernels.law_at(cold, self._coefficients, self._parts.law)
        self._state["freed"] = self._parts.law["free"]
        self._load(pretension)
        self._drive(rated, clamped=False)
        self._drive(cold, clamped=False)
        for _ in range(2):
            self._drive(rated, clamped=True)
            self._drive(cold, clamped=True)
        self._load(0.0)
        self._state["relaxing"] = 0.0
        kernels.law_at(cold, self._coefficients, self._parts.law)
        kernels.settle(False, 0.0, self._parts)
        # Lengths so far count from the muscle as made.
        self._coefficients["rest"] = self._state["length"]
        self._load(0.0)
