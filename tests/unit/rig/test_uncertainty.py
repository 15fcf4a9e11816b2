"""Uncertainties of signals: components of a rig file, budgets of readings, coverage factors."""

import math

import numpy as np
import pytest
from cases import cases
from pydantic import ValidationError

from bench.base import ConfigurationError
from bench.rig import BudgetRow, Calibration, Component, DerivedSignal, Expression, UncertainSignals, coverage_factor
from bench.rig.calibration import Calibrated
from rigs.vo2.curvature import CantileverCurvature, deflection_to_curvature

ABOUT = {"basis": "estimate", "source": "a test"}
UNITS = {"spot": "m", "curvature": "1/m"}
BEAM = CantileverCurvature(kind="cantilever-curvature", source="spot", length=300e-6)
PSD = {
    "lever": {"acts": "gain", "half_width": 0.5, "unit": "%"},
    "wave": {"acts": "nonlinearity", "half_width": 0.5, "unit": "µm", "distribution": "U", "range": [-1e-4, 1e-4]},
    "zero": {"acts": "offset", "half_width": 0.1e-6, "unit": "m", "distribution": "triangular"},
    "noise": {"acts": "noise", "standard": 20e-9, "unit": "m", "freedom": 9},
}


def signals(derived=None, units=UNITS, **stated):
    """The signals of a rig file with components."""
    components = {
        signal: {name: Component.model_validate({**ABOUT, **table}) for name, table in tables.items()}
        for signal, tables in stated.items()
    }
    return UncertainSignals(components, derived or {"curvature": BEAM}, units, "rig.toml")


def row(distribution, contribution, freedom=math.inf):
    return BudgetRow("spot", "part", "gain", "B", distribution, contribution, "m", freedom, contribution, "a test")


@cases(
    "rows, factor",
    [
        ([row("normal", 2.0)], 1.960),
        ([row("normal", 3.0), row("normal", 4.0)], 1.960),
        # Student's t, GUM table G.2.
        ([row("normal", 1.0, 5)], 2.571),
        # 0.95 of the half-width, √3 times the standard uncertainty.
        ([row("rectangular", 7.0)], 0.95 * math.sqrt(3.0)),
        ([row("triangular", 1.0)], (1.0 - math.sqrt(0.05)) * math.sqrt(6.0)),
        ([row("U", 1.0)], math.sin(0.475 * math.pi) * math.sqrt(2.0)),
    ],
)
def test_the_factor_of_one_distribution_is_that_of_its_interval(rows, factor):
    assert coverage_factor(rows) == pytest.approx(factor, abs=2e-3)


@cases(
    "parts",
    [
        {"U": 8.5, "normal": 4.0},
        {"rectangular": 5.0, "normal": 5.0},
        {"rectangular": 5.0, "triangular": 1.0, "normal": 0.5},
        {"U": 3.0, "rectangular": 1.5, "normal": 0.2},
    ],
)
def test_the_interval_of_a_sum_contains_95_percent_of_it(parts):
    rng = np.random.default_rng(0)
    count, root = 400_000, math.sqrt
    draws = {
        "normal": rng.standard_normal(count),
        "rectangular": rng.uniform(-root(3), root(3), count),
        "triangular": rng.triangular(-root(6), 0, root(6), count),
        "U": root(2) * np.sin(rng.uniform(0, 2 * np.pi, count)),
    }
    total = sum(size * draws[name] for name, size in parts.items())
    half = coverage_factor([row(name, size) for name, size in parts.items()]) * math.hypot(*parts.values())
    # What is neither normal nor the largest counts as normal.
    assert 0.945 < np.mean(np.abs(total) <= half) < 0.965


def test_a_budget_is_what_drawn_errors_make_of_the_curvature():
    stated = {"curvature": {"length": {"acts": "length", "half_width": 1.0, "unit": "µm"}}, "spot": PSD}
    deflection = 60e-6
    budget = signals(**stated).reading("curvature", {"spot": deflection}).budget()
    rng = np.random.default_rng(1)
    count = 4000
    phase = 2 * np.pi * (1.5 * (deflection + 1e-4) / 2e-4) + rng.uniform(0, 2 * np.pi, count)
    spots = (
        deflection * (1 + rng.uniform(-0.005, 0.005, count))
        + 0.5e-6 * np.sin(phase)
        + rng.triangular(-0.1e-6, 0, 0.1e-6, count)
        + 20e-9 * rng.standard_normal(count)
    )
    lengths = 300e-6 + rng.uniform(-1e-6, 1e-6, count)
    drawn = [float(deflection_to_curvature(spot, length)) for spot, length in zip(spots, lengths, strict=True)]
    assert budget.value == pytest.approx(float(deflection_to_curvature(deflection, 300e-6)))
    assert budget.standard == pytest.approx(np.std(drawn), rel=0.04)
    assert np.mean(np.abs(np.array(drawn) - budget.value) <= budget.expanded) == pytest.approx(0.95, abs=0.02)
    assert [each.component for each in budget.rows] == sorted(
        (each.component for each in budget.rows),
        key=lambda name: -next(each.contribution for each in budget.rows if each.component == name),
    )
    assert budget.freedom > 1000


def test_what_readings_have_in_common_is_not_in_their_difference():
    found = signals(spot=PSD)
    first, second = (found.reading("spot", {"spot": 5e-5}) for _ in range(2))
    assert (second.number - first.number).u == pytest.approx(math.sqrt(2) * 20e-9)
    other = found.reading("spot", {"spot": -5e-5}, noise=False)
    # A gain is of opposite sign there; the zero is the same; half a wave and a half lies between.
    apart = first.number - other.number
    assert apart.u > 1e-4 * 0.005 / math.sqrt(3)


def test_a_mean_of_readings_keeps_the_resolution_of_its_sensor():
    steps = {"acts": "resolution", "half_width": 40e-9, "unit": "m"}
    mean = signals(spot={**PSD, "steps": steps}).reading("spot", {"spot": 5e-5}, noise=False).repeated(1e-9, 9, "ten")
    parts = {each.component: each.contribution for each in mean.budget().rows}
    assert parts["steps"] == pytest.approx(40e-9 / math.sqrt(3.0))
    assert parts["repeatability"] == pytest.approx(1e-9)
    assert "noise" not in parts


@cases(
    "expression, constants",
    [
        ("spot / length", {"length": "300e-6 m"}),
        ("2 * spot / length ** 2 * length", {"length": "300e-6 m"}),
        ("sin(spot / length) + sqrt(abs(spot) / length)", {"length": "300 µm"}),
        ("max(spot, 0.5 * spot) / length", {"length": "300e-6 m"}),
    ],
)
def test_an_expression_of_uncertain_numbers_has_the_derivatives_that_differences_have(expression, constants):
    kind = Expression(expression=expression, unit="1", constants=constants)
    units = {"spot": "m", "ratio": "1"}
    stated = {
        "spot": {"noise": {"acts": "noise", "standard": 1e-7, "unit": "m"}},
        "ratio": {"length": {"acts": "length", "half_width": 2.0, "unit": "%"}},
    }
    exact = signals({"ratio": kind}, units, **stated).reading("ratio", {"spot": 4e-5}).budget()
    source = signals({}, units, spot=stated["spot"]).reading("spot", {"spot": 4e-5}).number
    numerical = DerivedSignal.uncertain(kind, "ratio", {"spot": "m"}, {"spot": source}, {})
    rows = {each.component: each.contribution for each in exact.rows}
    assert rows["noise"] == pytest.approx(float(numerical.u), rel=1e-6)
    assert exact.value == pytest.approx(kind.bind("ratio", {"spot": "m"}).compute({"spot": 4e-5}))

    def of_length(share):
        changed = Expression(expression=expression, unit="1", constants={"length": f"{300e-6 * (1 + share)!r} m"})
        return changed.bind("ratio", {"spot": "m"}).compute({"spot": 4e-5})

    slope = (of_length(1e-5) - of_length(-1e-5)) / 2e-5
    assert rows["length"] == pytest.approx(abs(slope) * 0.02 / math.sqrt(3), rel=1e-6)


def test_what_a_derived_signal_uses_twice_has_one_error():
    units = {"spot": "m", "double": "m", "triple": "m"}
    double, triple = (Expression(expression=text, unit="m") for text in ("2 * spot", "double + spot"))
    reading = signals({"double": double, "triple": triple}, units, spot=PSD).reading("triple", {"spot": 5e-5})
    alone = signals({}, units, spot=PSD).reading("spot", {"spot": 5e-5})
    budget = reading.budget()
    assert budget.standard == pytest.approx(reading.standard) == pytest.approx(3.0 * alone.standard)
    assert [row.contribution for row in budget.rows] == pytest.approx(
        [3.0 * row.contribution for row in alone.budget().rows]
    )


@cases("reference, share", [("goniometer 12", 0.0), ("goniometer 13", math.sqrt(2.0))])
def test_sensors_that_were_compared_with_one_reference_have_its_error_in_common(reference, share):
    about = {"unit": "m", "serial_number": "", "date": "2026-01-01", "interval_days": 365,
             "reference_unit": "m", "reference_uncertainty": 0.1, "low": 0.0, "high": 1.0, "coefficients": (0.0,),
             "covariance": ((0.0,),), "degrees_of_freedom": 9, "repeatability": 0.0, "readings": 10}  # fmt: skip
    derived = {
        name: Calibrated(
            kind="calibrated",
            source=source,
            calibration=Calibration.model_validate({**about, "signal": source, "reference": of}),
        )
        for name, source, of in (("first", "a", "goniometer 12"), ("second", "b", reference))
    }
    derived["apart"] = Expression(expression="first - second", unit="m")
    units = dict.fromkeys(("a", "b", *derived), "m")
    zero = {"zero": {"acts": "offset", "half_width": 1.0, "unit": "m"}}
    found = signals(derived, units, a=zero, b=zero).reading("apart", {"a": 0.5, "b": 0.5})
    assert found.standard == pytest.approx(0.1 * share, abs=1e-12)
    assert found.budget().standard == pytest.approx(0.1 * share, abs=1e-12)


def test_a_value_is_the_same_whether_it_is_read_or_asked_for():
    found = signals(spot=PSD)
    read = found.reading("curvature", {"spot": 7e-5})
    asked = signals(spot=PSD).at("curvature", read.number.x)
    assert asked.standard == pytest.approx(read.standard, rel=1e-6)


def test_people_read_a_budget_in_the_unit_that_fits_its_value():
    budget = signals(spot=PSD).reading("spot", {"spot": 7e-5}).budget()
    shown = budget.in_fitting_unit()
    assert (shown.unit, shown.value) == ("µm", pytest.approx(70.0))
    assert shown.expanded == pytest.approx(1e6 * budget.expanded)
    assert shown.factor == pytest.approx(budget.factor)
    for before, after in zip(budget.rows, shown.rows, strict=True):
        assert after.contribution == pytest.approx(1e6 * before.contribution)
        # The gain stays in percent.
        assert after.unit == ("µm" if before.unit == "m" else before.unit)
    assert f"{shown.expanded:.2g} µm" in shown.advice()


def test_what_is_not_stated_is_named():
    found = signals(spot=PSD, units={**UNITS, "other": "V"})
    assert found.stated(["spot", "curvature", "other"]) == ["spot", "curvature"]
    budget = found.reading("other", {"other": 1.0}).budget()
    assert not budget.stated
    assert budget.not_stated == ("other",)
    assert "other" in budget.advice()


def test_how_a_quantity_follows_the_room_is_no_error_of_its_readings():
    room = {"acts": "room", "standard": 2.0, "unit": "µm", "time": 400.0}
    plain, found = signals(spot=PSD), signals(spot={**PSD, "room": room})
    assert found.reading("spot", {"spot": 5e-5}).standard == plain.reading("spot", {"spot": 5e-5}).standard
    assert plain.room(["spot"]) is None
    stated = found.room(["curvature", "spot"])
    assert (stated.contribution, stated.time) == (pytest.approx(2e-6), 400.0)
    # Alone it does not say how well a reading is known.
    assert signals(spot={"room": room}).stated(["spot", "curvature"]) == []


@cases(
    "change, problem",
    [
        ({"half_width": -1.0}, "half_width"),
        ({"half_width": None}, "standard or half_width"),
        ({"standard": 1.0}, "standard or half_width"),
        ({"distribution": "normal"}, "normal with standard"),
        ({"freedom": 0.0}, "freedom"),
        ({"source": ""}, "source"),
        ({"range": [0.0, 1.0]}, "nonlinearity"),
        ({"time": 60.0}, "room or a drift"),
        ({"unit": ""}, "unit"),
        ({"sigma": 1.0}, "sigma"),
    ],
)
def test_a_wrong_component_is_refused(change, problem):
    table = {**ABOUT, "acts": "offset", "half_width": 1e-6, "unit": "m", **change}
    with pytest.raises(ValidationError) as caught:
        Component.model_validate({key: value for key, value in table.items() if value is not None})
    assert len(caught.value.errors()) == 1
    assert problem in str(caught.value)


@cases(
    "signal, change, problem",
    [
        ("spot", {"unit": "V"}, "expected m"),
        ("spot", {"acts": "gain", "unit": "m"}, "expected %"),
        ("spot", {"acts": "length"}, "acts"),
        ("curvature", {"acts": "width"}, "length"),
        ("curvature", {"acts": "length", "unit": "K"}, "expected m"),
        ("sport", {}, "no signal"),
    ],
)
def test_a_component_that_does_not_fit_its_signal_is_refused_with_its_key(signal, change, problem):
    table = {"acts": "offset", "half_width": 1e-6, "unit": "m", **change}
    with pytest.raises(ConfigurationError, match=rf"rig\.toml: uncertainty\.{signal}\.part: .*{problem}"):
        signals(**{signal: {"part": table}})
