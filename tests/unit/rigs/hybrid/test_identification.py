"""From runs of the hybrid to its model: on samples that are made up, and on short runs recorded here."""

import math

import numpy as np
import pytest
from cases import cases
from short_runs import record_run

from bench.base import DataError
from bench.models import PrandtlIshlinskii
from bench.record import FILE_NAME, Table
from rigs.hybrid.identification import (
    BASE,
    CURRENT,
    DEFLECTION,
    VOLTAGE,
    Samples,
    bandwidth_of,
    identify_hybrid,
    identify_piezo,
    read_loop,
    read_loops,
    sine_at,
)
from rigs.hybrid.model import identify_pi

# As few and as short as the parts can still be identified from.
SHORT = {
    "current-steps": {"levels": "-0.1, 0.1", "on": "300", "off": "300"},
    "thermomechanical": {"levels": "4", "dwell": "150"},
    "piezo-loops": {"amplitudes": "40, 20"},
    "piezo-step": {"duration": "0.15"},
    "current-sine": {"frequencies": "0.003, 0.006", "amplitude": "0.02"},
    "hybrid-excitation": {"duration": "20"},
}
PARTS = ("current-steps", "thermomechanical", "piezo-loops", "piezo-step")


def record_short_run(folder, protocol, rig="hybrid", overrides=None, **settings):
    return record_run(folder, protocol, rig, {**SHORT[protocol], **settings}, overrides)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """The folder of a completed run of each protocol, and `failed` for one that was not completed."""
    folder = tmp_path_factory.mktemp("runs")
    results = {name: record_short_run(folder, name) for name in SHORT}
    assert all(result.outcome.status == "completed" for result in results.values())
    failed = record_short_run(
        folder, "piezo-loops", overrides={"emulation.fault": "open-thermistor", "emulation.fault_time": "5"}
    )
    assert failed.outcome.status == "failed"
    return {name: result.folder for name, result in results.items()} | {"failed": failed.folder}


@pytest.fixture(scope="module")
def found(runs):
    return identify_hybrid(*(runs[name] for name in PARTS))


@pytest.fixture
def changed(runs, tmp_path, edit_journal):
    """Copy a run and change its journal; return the copy."""

    def change(name, *statements):
        (tmp_path / FILE_NAME).write_bytes((runs[name] / FILE_NAME).read_bytes())
        edit_journal(tmp_path / FILE_NAME, *statements)
        return tmp_path

    return change


def made_up(period, **signals):
    return Samples(Table({name: np.asarray(values, dtype=np.float64) for name, values in signals.items()}), period)


class TestReading:
    def test_one_loop_with_its_rate(self, runs):
        samples = read_loop(runs["current-steps"])
        assert samples.period == pytest.approx(1.0, rel=1e-12)
        assert len(samples.times) == 1200
        np.testing.assert_allclose(samples.times, np.arange(1200.0))
        current = samples[CURRENT]
        assert current.tolist() == [-0.1] * 300 + [0.0] * 300 + [0.1] * 300 + [0.0] * 300
        # A negative current cools, and that bends up.
        assert samples[BASE][299] < 20.0 < samples[BASE][0]
        assert samples[DEFLECTION][299] > 30e-6

    def test_several_by_their_labels(self, runs):
        loops = read_loops(runs["current-sine"])
        assert list(loops) == ["0.003 Hz", "0.006 Hz"]
        assert [len(samples.times) for samples in loops.values()] == [333, 167]
        for samples in loops.values():
            assert samples.period == pytest.approx(2.0, rel=1e-12)
        with pytest.raises(DataError, match=r"current-sine.*: expected one fast loop, found 2"):
            read_loop(runs["current-sine"])

    def test_two_loops_of_one_label_are_refused(self, tmp_path):
        result = record_short_run(tmp_path, "current-sine", frequencies="0.01, 0.01")
        with pytest.raises(DataError, match=r"has two loops '0.01 Hz'; expected one of each label"):
            read_loops(result.folder)

    def test_an_incomplete_run_is_refused(self, runs):
        with pytest.raises(DataError, match=r"piezo-loops.*: the run is failed; a model needs a completed one"):
            read_loops(runs["failed"])

    def test_a_run_without_a_loop(self, runs):
        with pytest.raises(DataError, match=r"thermomechanical.*: has no fast loop"):
            read_loops(runs["thermomechanical"])

    def test_a_run_whose_loop_was_not_recorded(self, changed):
        run = changed("piezo-loops", "DELETE FROM telemetry")
        with pytest.raises(DataError, match="has no fast loop"):
            read_loops(run)

    @pytest.mark.parametrize("condition", ["t BETWEEN 5.0 AND 5.03", "t > 1.0 AND t < 19.0"], ids=["two", "most"])
    def test_samples_that_were_left_out(self, changed, condition):
        run = changed("piezo-loops", f"DELETE FROM telemetry WHERE {condition}")
        with pytest.raises(DataError, match="the loop 'piezo loops' left samples out; a model needs all of them"):
            read_loop(run)

    def test_samples_that_came_late_count_as_of_their_instants(self, runs, changed):
        run = changed("piezo-loops", "UPDATE telemetry SET t = t + 0.004, lateness = 0.004 WHERE tick % 3 = 0")
        samples = read_loop(run)
        assert samples.period == pytest.approx(0.02, rel=1e-9)
        assert len(samples.times) == 1000
        np.testing.assert_array_equal(samples[DEFLECTION], read_loop(runs["piezo-loops"])[DEFLECTION])

    def test_what_is_no_run(self, tmp_path):
        with pytest.raises(DataError, match="is not a run"):
            read_loops(tmp_path)


class TestSine:
    @cases(("rate", "frequency", "count"), [(0.5, 0.001, 1000), (50.0, 1.7, 400), (10.0, 0.1, 1000)])
    def test_amplitude_and_phase_with_offset_and_drift(self, rate, frequency, count):
        times = np.arange(count) / rate
        wanted = 3e-6 * np.exp(0.7j)
        values = 3e-6 * np.sin(2 * np.pi * frequency * times + 0.7) + 2e-5 - 1e-6 * times / times[-1]
        samples = made_up(1 / rate, y=values)
        assert abs(sine_at(samples, "y", frequency) - wanted) < 1e-11

    def test_the_transient_of_the_first_period_does_not_count(self):
        times = np.arange(500) / 10.0
        values = np.sin(2 * np.pi * 0.1 * times) + np.where(times < 10.0, 5.0 * (10.0 - times), 0.0)
        assert sine_at(made_up(0.1, y=values), "y", 0.1) == pytest.approx(1.0, abs=1e-12)

    def test_a_period_need_not_be_a_whole_number_of_samples(self):
        """Two periods of 3 mHz at 0.5 Hz are 333 samples and a third."""
        for periods in (2, 3, 4, 5):
            count = round(periods / 0.003 * 0.5)
            times = 2.0 * np.arange(count)
            values = np.sin(2 * np.pi * 0.003 * times + 0.2)
            # Wrong in the first period, which is all that may be left out.
            values[: math.floor(count - (periods - 1) / 0.006 - 1)] += 10.0
            found = sine_at(made_up(2.0, y=values), "y", 0.003)
            assert abs(found - np.exp(0.2j)) < 1e-9, periods

    @cases("count", [1, 50, 150, 198])
    def test_less_than_two_periods_are_refused(self, count):
        with pytest.raises(DataError, match=r"a sine of 0.1 Hz needs at least two periods"):
            sine_at(made_up(0.1, y=np.zeros(count)), "y", 0.1)

    def test_of_a_run(self, runs):
        for label, samples in read_loops(runs["current-sine"]).items():
            current = sine_at(samples, CURRENT, float(label.split()[0]))
            assert current == pytest.approx(0.02, abs=1e-4)
            response = sine_at(samples, DEFLECTION, float(label.split()[0]))
            # Heating bends down, and the temperature lags.
            assert np.angle(-response) < -0.3
            assert 2e-6 < abs(response) < 60e-6


class TestBandwidth:
    @cases("corner", [2.5e-3, 4.2e-3, 7.0e-3])
    @cases("lowest", [1e-4, 1e-3])
    def test_of_a_lag_of_first_order(self, corner, lowest):
        frequencies = np.geomspace(lowest, 20e-3, 100)
        gains = 5.0 / np.sqrt(1 + (frequencies / corner) ** 2)
        # 3 dB below the lowest of them: 1 + (f/c)² = 2 (1 + (l/c)²).
        expected = math.sqrt(corner**2 + 2 * lowest**2)
        assert bandwidth_of(frequencies, gains) == pytest.approx(expected, rel=2e-3)

    def test_straight_lines_of_the_bode_plot_are_met_exactly(self):
        frequencies = np.array([1.0, 2.0, 8.0])
        gains = np.array([1.0, 1.0, 0.25])
        assert bandwidth_of(frequencies, gains) == pytest.approx(2.0 * math.sqrt(2.0), rel=1e-12)

    def test_a_bump_that_stays_above_does_not_count(self):
        gains = np.array([1.0, 0.8, 1.5, 0.6, 0.9])
        assert 3.0 < bandwidth_of(np.array([1.0, 2.0, 3.0, 4.0, 5.0]), gains) < 4.0

    @cases("gains", [[1.0, 0.9, 0.8], [1.0, math.nan, 0.8]])
    def test_one_that_is_not_reached(self, gains):
        with pytest.raises(DataError, match=r"the gain has not fallen by 3 dB up to 0.008 Hz"):
            bandwidth_of(np.array([0.001, 0.004, 0.008]), np.array(gains))


class TestPiezo:
    OPERATOR = PrandtlIshlinskii(
        np.arange(15) * 40.0 / 15,
        np.array([150.0, *np.linspace(40.0, 2.0, 14)]) * 1e-9,
        2e-7,
        input_range=(-40.0, 40.0),
    )

    def samples(self, drift, noise=0.0):
        times = np.arange(2500) / 50.0
        amplitudes = np.array([40.0, 40.0, 30.0, 20.0, 10.0])[np.minimum((times * 0.1).astype(int), 4)]
        voltages = amplitudes * np.sin(2 * np.pi * 0.1 * times)
        deflections = self.OPERATOR.evaluate(np.append(0.0, voltages[:-1])) + drift(times - times.mean())
        deflections = deflections + noise * np.random.default_rng(2).standard_normal(times.size)
        return made_up(0.02, **{VOLTAGE: voltages, DEFLECTION: deflections})

    def test_the_operator_comes_back(self):
        found = identify_piezo(self.samples(np.zeros_like))
        assert found.errors.rms < 1e-12
        np.testing.assert_allclose(found.operator.weights, self.OPERATOR.weights, atol=1e-12)

    @cases("drift", [lambda t: 2e-8 * t, lambda t: 1e-9 * t**2, lambda t: -3e-8 * t + 5e-10 * t**2])
    def test_without_what_drifts(self, drift):
        samples = self.samples(drift, noise=10e-9)
        found = identify_piezo(samples)
        with_drift = identify_pi(found.voltages, samples[DEFLECTION])
        # What is left is the noise.
        assert found.errors.rms == pytest.approx(10e-9, rel=0.05)
        assert with_drift.errors.rms > 100e-9
        np.testing.assert_allclose(found.operator.weights[:4], self.OPERATOR.weights[:4], rtol=0.05)
        assert np.std(found.deflections - self.OPERATOR.evaluate(found.voltages)) == pytest.approx(10e-9, rel=0.05)

    def test_a_sample_is_read_before_its_voltage_is_sent(self):
        samples = self.samples(np.zeros_like)
        found = identify_piezo(samples)
        assert found.voltages[0] == 0.0
        np.testing.assert_array_equal(found.voltages[1:], samples[VOLTAGE][:-1])


class TestIdentifying:
    def test_each_part(self, found):
        model = found.model
        assert 4e-3 < model.bandwidth() < 5.5e-3
        assert found.network.base.rms < 0.1
        assert found.network.tip.rms < 0.15
        assert 2 <= found.order.order <= 5
        assert found.polynomial.errors.rms < 0.3e-6
        # Hotter is lower, by some seven micrometres in a kelvin.
        assert -9e-6 < model.thermal_deflection([1.0])[0] < -6e-6
        assert found.piezo.errors.rms_percent <= 1.0
        assert model.dynamics.real_pole == pytest.approx(1274.0, rel=0.02)
        assert model.dynamics.frequency == pytest.approx(math.sqrt(1.9e7), rel=1e-3)
        assert (model.reference, model.hysteresis) == (22.0, found.piezo.operator)
        assert model.hysteresis.thresholds.size == 15

    def test_the_whole_follows_a_run_of_its_own(self, runs, found):
        samples = read_loop(runs["hybrid-excitation"])
        response = found.model.simulate(samples[CURRENT], samples[VOLTAGE], samples.period, float(samples[BASE][0]))
        measured = samples[DEFLECTION] - samples[DEFLECTION][0]
        assert np.ptp(measured) > 10e-6
        assert np.std(measured - response.deflections) < 0.05 * np.ptp(measured)

    @cases("place", range(4))
    @cases("other", [*PARTS, "hybrid-excitation"])
    def test_a_run_of_another_kind_is_refused(self, runs, place, other):
        names = list(PARTS)
        if names[place] == other:
            return
        names[place] = other
        with pytest.raises(DataError) as caught:
            identify_hybrid(*(runs[name] for name in names))
        assert str(caught.value) == f"{runs[other]}: is a run of {other}; expected one of {PARTS[place]}"

    @pytest.mark.parametrize("place", range(4))
    def test_an_incomplete_run_is_refused(self, runs, changed, place):
        folders = [runs[name] for name in PARTS]
        folders[place] = changed(PARTS[place], "UPDATE meta SET value = '\"aborted\"' WHERE key = 'status'")
        with pytest.raises(DataError, match="the run is aborted; a model needs a completed one") as caught:
            identify_hybrid(*folders)
        assert str(folders[place]) in str(caught.value)

    @pytest.mark.parametrize(
        ("protocol", "settings", "words"),
        [
            ("current-steps", {"levels": "0", "on": "30", "off": "30"}, "the hybrid cannot be identified: "),
            (
                "thermomechanical",
                {"coldest": "0", "hottest": "0", "levels": "2", "dwell": "10"},
                "the hybrid cannot be identified: ",
            ),
            ("piezo-loops", {"amplitudes": "0"}, "voltages: expected values that vary"),
            ("piezo-step", {"voltage": "0", "duration": "0.01"}, "inputs: expected exactly one step, got 0"),
        ],
    )
    def test_a_run_that_shows_nothing_is_refused(self, runs, tmp_path, protocol, settings, words):
        empty = record_short_run(tmp_path, protocol, **settings).folder
        with pytest.raises(DataError, match=words):
            identify_hybrid(*(empty if name == protocol else runs[name] for name in PARTS))
