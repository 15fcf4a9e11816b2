"""From runs of a muscle to models, on short runs of the rig `sma` recorded here."""

import re
from functools import cache

import numpy as np
import pytest
from cases import cases
from short_runs import record_run

from bench.base import DataError
from bench.identification import load_model, measure_series, predict_series
from bench.models import Linear, Summed, TwoStage
from bench.record import FILE_NAME, Record
from protocols.muscles.force_voltage import scaled_steps
from rigs.muscles.identification import (
    FORCE,
    LENGTH,
    MODELS,
    SAMPLE,
    Resting,
    errors_json,
    identify_muscle,
    identify_resting,
    muscle_file,
    read_resting,
    read_series,
)

LOADS = (0.98, 4.9, 8.82)
VOLTAGES = (0.0, 1.5, 3.0)
# Few points, and dwells in which the wire only just settles.
SHORT = {
    "force-voltage": {"points": "13", "conditioning": "1", "dwell": "20"},
    "length-voltage": {"points": "13", "loads": ", ".join(map(str, LOADS)), "dwell": "8"},
    "length-force": {"points": "4", "voltages": ", ".join(map(str, VOLTAGES)), "dwell": "8"},
    "length-verification": {"points": "1", "loads": "4.9, 4.9", "dwell": "2"},
    "creep": {"duration": "4", "settling": "2"},
}


def record_short_run(folder, protocol, rig="sma", overrides=None, **settings):
    return record_run(folder, protocol, rig, {**SHORT[protocol], **settings}, overrides)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """The folder of a completed run of each protocol."""
    folder = tmp_path_factory.mktemp("runs")
    results = {name: record_short_run(folder, name, "vo2" if name == "creep" else "sma") for name in SHORT}
    assert all(result.outcome.status == "completed" for result in results.values())
    return {name: result.folder for name, result in results.items()}


@pytest.fixture(scope="module")
def resting(runs):
    return read_resting(runs["force-voltage"])


@pytest.fixture(scope="module")
def series(runs):
    return [*read_series(runs["length-voltage"]), *read_series(runs["length-force"])]


@pytest.fixture(scope="module")
def fitted(resting, series):
    """Each model by its name, identified once."""
    return cache(lambda name: identify_muscle(name, resting, series))


class TestReading:
    def test_force_at_resting_length(self, runs, resting):
        np.testing.assert_allclose(resting.voltages, scaled_steps(3.0, 13), atol=1e-9)
        # Seeds 0 to 3 give 0.18 to 0.28 N.
        assert resting.forces[0] == pytest.approx(0.3, abs=0.15)
        assert 7.0 < resting.forces[resting.voltages.argmax()] < 12.0
        with Record(runs["force-voltage"]) as record:
            names = [signal.name for signal in record.signals]
            samples = [step for step in record.step_records() if step.label == SAMPLE]
        np.testing.assert_array_equal(resting.forces, [step.values[names.index(FORCE)] for step in samples])

    def test_length_under_each_load(self, series):
        found = [one for one in series if one.kind == "length-voltage"]
        assert len(found) == len(LOADS)
        for load, one in zip(LOADS, found, strict=True):
            np.testing.assert_allclose(one.forces, load, atol=0.05)
            assert np.ptp(one.forces) == 0.0
            np.testing.assert_allclose(one.voltages, scaled_steps(3.0, 13), atol=1e-9)
            # A heated wire is shorter.
            assert one.lengths[one.voltages.argmax()] < one.lengths[0] - 2e-3

    def test_length_at_each_voltage(self, series):
        found = [one for one in series if one.kind == "length-force"]
        assert [one.voltages[0] for one in found] == list(VOLTAGES)
        for one in found:
            np.testing.assert_allclose(one.forces, [0.3, 3.7, 7.1, 10.5, 7.1, 3.7, 0.3], atol=0.3)
            assert one.lengths[3] > one.lengths[0] + 0.5e-3

    def test_series_of_the_same_load_stay_apart(self, runs):
        found = read_series(runs["length-verification"])
        assert [one.lengths.size for one in found] == [1, 1]
        assert [one.kind for one in found] == ["length-voltage"] * 2
        assert found[0].voltages[0] == found[1].voltages[0]

    def test_an_incomplete_run_is_refused(self, tmp_path):
        result = record_short_run(
            tmp_path,
            "length-voltage",
            overrides={"emulation.fault": "missing-heartbeat", "emulation.fault_time": "90"},
        )
        assert result.outcome.status == "failed"
        with pytest.raises(DataError, match="the run is failed; a model needs a completed one"):
            read_series(result.folder)

    @cases("other", ["length-voltage", "length-force", "length-verification", "creep"])
    def test_another_protocol_is_no_resting_one(self, runs, other):
        with pytest.raises(
            DataError, match=f"{re.escape(runs[other].name)}: is a run of {other}; expected one of force-voltage$"
        ):
            read_resting(runs[other])

    @cases("other", ["force-voltage", "creep"])
    def test_another_protocol_has_no_series(self, runs, other):
        expected = "length-voltage or length-force or length-verification"
        with pytest.raises(
            DataError, match=f"{re.escape(runs[other].name)}: is a run of {other}; expected one of {expected}$"
        ):
            read_series(runs[other])

    @pytest.mark.parametrize(
        ("statement", "words"),
        [
            (f"UPDATE steps SET label = 'other' WHERE label = '{SAMPLE}'", "has no readings with the label 'sample'"),
            (f"UPDATE signals SET name = 'other' WHERE name = '{LENGTH}'", f"table signals has no row of {LENGTH}"),
            ("UPDATE meta SET value = '\"aborted\"' WHERE key = 'status'", "the run is aborted"),
            ("DELETE FROM meta WHERE key = 'status'", "the run is unfinished"),
        ],
        ids=["samples", "signal", "aborted", "unfinished"],
    )
    @pytest.mark.parametrize(("protocol", "read"), [("force-voltage", read_resting), ("length-voltage", read_series)])
    def test_what_a_run_lacks_is_named(self, runs, tmp_path, edit_journal, protocol, read, statement, words):
        (tmp_path / FILE_NAME).write_bytes((runs[protocol] / FILE_NAME).read_bytes())
        edit_journal(tmp_path / FILE_NAME, statement)
        with pytest.raises(DataError, match=words) as caught:
            read(tmp_path)
        assert str(tmp_path) in str(caught.value)

    def test_what_is_no_run_is_refused(self, tmp_path):
        with pytest.raises(DataError, match="is not a run"):
            read_series(tmp_path)


KINDS = {
    "two-stage": TwoStage,
    "two-stage-prandtl-ishlinskii": TwoStage,
    "summed": Summed,
    "linear": Linear,
}


class TestIdentifying:
    @pytest.mark.parametrize("name", MODELS)
    def test_each_model(self, name, runs, resting, series, fitted, tmp_path):
        found = fitted(name)
        assert isinstance(found.model, KINDS[name])
        assert set(found.errors) == {"length-voltage", "length-force"} | (
            set() if name == "summed" else {"force-voltage"}
        )
        assert all(0.0 < errors.rms_percent < 20.0 for errors in found.errors.values())
        assert all(certificate.kkt_residual < 1e-10 for certificate in found.certificates.values())
        assert found.model.pretension == resting.pretension == 0.3

        file = muscle_file(name, found, [runs["force-voltage"], runs["length-voltage"]], None)
        file.save(tmp_path / "model.json")
        again = load_model(tmp_path / "model.json")
        assert again.name == name
        assert again.provenance["sources"] == [runs["force-voltage"].name, runs["length-voltage"].name]
        assert again.provenance["errors"] == {kind: errors_json(errors) for kind, errors in found.errors.items()}
        assert all(residual < 1e-10 for residual in again.provenance["kkt"].values())
        # Chosen for each model alike; 15 plays have no density to smooth.
        assert again.provenance["smoothing"] == found.smoothing
        assert (found.smoothing["second"] == 0.0) or name != "two-stage-prandtl-ishlinskii"
        for one in series:
            np.testing.assert_array_equal(predict_series(again.model, one), predict_series(found.model, one))
        assert again.model.to_json() == found.model.to_json()

    def test_errors_say_what_predictions_miss(self, series, fitted):
        found = fitted("two-stage")
        chosen = [one for one in series if one.kind == "length-force"]
        errors = measure_series(found.model, chosen)
        assert errors_json(errors) == errors_json(found.errors["length-force"])
        lengths = np.concatenate([one.lengths for one in chosen])
        missed = lengths - np.concatenate([predict_series(found.model, one) for one in chosen])
        rms = np.sqrt(np.mean(missed**2))
        assert errors_json(errors)["rms"] == pytest.approx(100 * rms / np.ptp(lengths), rel=1e-9)

    @cases("name", MODELS)
    def test_without_lengths_nothing_is_identified(self, name, resting):
        with pytest.raises(DataError, match=f"model {name} cannot be identified: .*series"):
            identify_muscle(name, resting, [])

    @pytest.mark.parametrize("name", ["two-stage", "linear"])
    def test_without_the_cold_muscle_nothing_is_identified(self, name, resting, series):
        hot = Resting(resting.voltages[1:3], resting.forces[1:3], resting.pretension)
        with pytest.raises(DataError, match=f"model {name} cannot be identified: voltages: .*lowest voltage"):
            identify_muscle(name, hot, series)
        with pytest.raises(DataError, match=r"force over the voltage cannot be identified: .*lowest voltage"):
            identify_resting(hot)
