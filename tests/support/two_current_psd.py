"""A position-sensitive detector whose two photocurrents are amplified to two voltages."""

from sim_devices.noise import normals


class TwoCurrentPSD:
    """The spot at x on a detector of length L gives x = (L/2)(I2 − I1)/(I1 + I2) (Hamamatsu, S3270 datasheet).

    A spot beyond the end of the detector gives no current at all. The amplifiers saturate at 0 and 10 V.
    """

    def __init__(self, deflection, rng):
        self.deflection = deflection
        self.light = 1.0
        """Share of the light that reaches the detector."""
        self._normals = normals(rng)

    def first(self):
        return self._amplified(-1.0)

    def second(self):
        return self._amplified(1.0)

    def _amplified(self, side):
        ratio = self.deflection() * (2 * 185.0 / 0.037)
        share = (1 + side * ratio) / 2 if abs(ratio) <= 1 else 0.0
        volts = self.light * 8.0 * share + 5e-3 * next(self._normals)
        return min(max(volts, 0.0), 10.0)
