import math

import numpy as np
import pytest
from cases import cases
from hypothesis import given, strategies as st
from pydantic import ValidationError

from bench.base import DeviceError
from rigs.vo2.curvature import CantileverCurvature, curvature_to_deflection, deflection_to_curvature

LENGTH = 300e-6
LARGEST_ANGLE = 2.331122370414423  # tan(x/2) = x
LARGEST_DEFLECTION = 0.7246113537767085  # in lengths, at that angle


def arc(curvature, length=LENGTH):
    """Deflection of an arc as the paper writes it, without any care for small curvatures."""
    return 2.0 / curvature * math.sin(length * curvature / 2.0) ** 2


class TestForward:
    @given(st.floats(1.0, 7700.0), st.booleans())
    def test_is_the_arc(self, curvature, negative):
        curvature = -curvature if negative else curvature
        assert float(curvature_to_deflection(curvature, LENGTH)) == pytest.approx(arc(curvature), rel=1e-12)

    def test_counts_from_the_residual_curvature(self):
        got = float(curvature_to_deflection(1500.0, LENGTH, 400.0))
        assert got == pytest.approx(arc(1900.0) - arc(400.0), rel=1e-12)


class TestInverse:
    @given(
        st.floats(-0.98, 0.98),
        st.sampled_from([0.0, 200.0, 500.0, 1000.0, -1000.0]),
        st.sampled_from([50e-6, 300e-6, 5e-3]),
    )
    def test_undoes_the_forward_way_over_the_whole_range(self, share, residual, length):
        residual = residual * LENGTH / length
        total = share * LARGEST_ANGLE / length
        change = total - residual
        deflection = curvature_to_deflection(change, length, residual)
        back = float(deflection_to_curvature(deflection, length, residual))
        assert back == pytest.approx(change, rel=1e-10, abs=1e-10 / length)

    def test_grows_up_to_the_end_of_the_range(self):
        deflections = np.linspace(-1.0, 1.0, 20001)[1:-1] * LARGEST_DEFLECTION * LENGTH
        curvatures = deflection_to_curvature(deflections, LENGTH)
        assert np.all(np.isfinite(curvatures))
        assert np.all(np.diff(curvatures) > 0)
        assert np.abs(curvatures).max() * LENGTH < LARGEST_ANGLE

    @cases("below", [1e-3, 1e-6, 1e-9, 1e-12, 1e-15, 1.2e-16])
    def test_is_right_close_to_where_it_ends(self, below):
        deflection = LARGEST_DEFLECTION * (1.0 - below) * LENGTH
        angle = float(deflection_to_curvature(deflection, LENGTH)) * LENGTH
        # The curve is flat there: half of the digits of the angle are lost, none of the deflection.
        assert angle == pytest.approx(LARGEST_ANGLE, abs=3.0 * math.sqrt(below) + 1e-7)

    @cases("share", [0.7247, 1.0, 10.0, math.inf, math.nan])
    @cases("sign", [1.0, -1.0])
    def test_is_nan_beyond_reach(self, share, sign):
        assert math.isnan(float(deflection_to_curvature(sign * share * LENGTH, LENGTH)))

    def test_one_value_beyond_reach_does_not_harm_the_others(self):
        curvatures = deflection_to_curvature([80.97e-6, 299e-6, math.nan, -10e-6], LENGTH)
        np.testing.assert_array_equal(np.isnan(curvatures), [False, True, True, False])
        assert curvatures[0] == pytest.approx(1846.0, abs=0.2)


@cases("length", [0.0, -1e-6, math.nan, math.inf])
@cases("convert", [curvature_to_deflection, deflection_to_curvature])
def test_refuses_a_length_that_is_none(convert, length):
    with pytest.raises(ValueError, match="length: expected a positive number"):
        convert(1.0, length)


class TestDerivedSignal:
    def make(self, **keys):
        return CantileverCurvature(
            **{"kind": "cantilever-curvature", "source": "psd_position", "length": LENGTH, **keys}
        )

    def compute(self, derived, values):
        return derived.bind("curvature", {"psd_position": "m"}).compute(values)

    def test_computes_from_the_source(self):
        curvature = self.compute(self.make(), {"psd_position": 80.97e-6, "tec_temperature": 60.0})
        assert curvature == pytest.approx(1846.0, abs=0.2)
        assert self.make().bind("curvature", {"psd_position": "m"}).signal.unit == "1/m"

    def test_takes_the_residual_curvature_into_account(self):
        deflection = float(curvature_to_deflection(1846.0, LENGTH, 500.0))
        got = self.compute(self.make(residual_curvature=500.0), {"psd_position": deflection})
        assert got == pytest.approx(1846.0, rel=1e-9)

    def test_an_impossible_deflection_is_a_fault(self):
        with pytest.raises(DeviceError, match=r"a beam of 300 µm cannot bend by 250\.0 µm"):
            self.compute(self.make(), {"psd_position": 250e-6})

    def test_nan_stays_nan(self):
        assert math.isnan(self.compute(self.make(), {"psd_position": math.nan}))

    def test_a_residual_curvature_without_inverse_is_refused(self):
        # Beyond 2.33 rad one deflection has two curvatures, and no deflection at all would not mean no change.
        with pytest.raises(ValidationError, match="residual_curvature"):
            self.make(residual_curvature=8000.0)
        with pytest.raises(ValidationError, match="residual_curvature"):
            self.make(residual_curvature=-8000.0)
        assert self.compute(self.make(residual_curvature=7000.0), {"psd_position": 0.0}) == pytest.approx(
            0.0, abs=1e-6
        )
