"""Models with time from the command line: `identify`, then `predict` and `model test` with the same errors."""

import json
from pathlib import Path

import numpy as np
import pytest

from bench.base import ConfigurationError
from bench.models import BoucWenOscillator, Hammerstein, LinearPart, Preisach, RateDependentPlays, uniform_levels

COLUMNS = ("--time", "time", "--input", "drive", "--output", "response")


def write(path, t, u, y, header="time [ms],drive [V],response [um]"):
    np.savetxt(path, np.column_stack([t, u, y]), delimiter=",", header=header, comments="", fmt="%.17g")
    return str(path)


def hammerstein(folder):
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(5e-4, 2e-3, 400))
    u = 5.0 + 5.0 * np.sin(2.0 * np.pi * 12.0 * t) * (1.0 - t)
    model = Hammerstein(Preisach(uniform_levels(0.0, 10.0, 5), rng.random(15)), LinearPart(0.0, (0.004, 0.0)))
    return write(folder / "lagging.csv", 1e3 * t, u, model.evaluate(t, u) + rng.normal(0.0, 0.01, 400))


def plays(folder):
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(5e-4, 2e-3, 400))
    u = 5.0 + 5.0 * np.sin(2.0 * np.pi * 12.0 * t) * (1.0 - t)
    model = RateDependentPlays(np.arange(4.0), [0.0, 0.004, 0.004, 0.004], [1.0, 0.5, 0.3, 0.2], (0.0, 10.0))
    return write(folder / "dragged.csv", 1e3 * t, u, model.evaluate(t, u) + rng.normal(0.0, 0.01, 400))


def oscillator(folder):
    rng = np.random.default_rng(0)
    t = np.arange(512) / 750.0
    lines = np.fft.rfftfreq(512, 1.0 / 750.0)
    u = np.fft.irfft((lines > 5.0) * (lines < 150.0) * np.exp(2j * np.pi * rng.random(lines.size)), 512)
    u *= 50.0 / u.std()
    model = BoucWenOscillator(0.002, 0.01, 50.0, 50.0, 0.8, -1.1, 0.0, (-200.0, 200.0))
    return write(folder / "swinging.csv", 1e3 * t, u, model.evaluate(t, u) + rng.normal(0.0, 8e-3, 512))


@pytest.mark.parametrize(
    ("make", "options"),
    [
        (hammerstein, ("--model", "hammerstein", "--levels", 5, "-o", "dynamics=lag")),
        (hammerstein, ("--model", "hammerstein", "--levels", 5, "-o", "dynamics=none", "--skip", 20)),
        (
            hammerstein,
            ("--model", "hammerstein", "-o", "static=polynomial", "-o", "degree=3", "-o", "dynamics=lag,drift"),
        ),
        (plays, ("--model", "rate-dependent-plays", "-o", "plays=10", "-o", "time_constants=1")),
        (plays, ("--model", "rate-dependent-plays", "--initial", "skip", "-o", "maximum=4")),
        pytest.param(oscillator, ("--model", "bouc-wen-oscillator"), marks=pytest.mark.seeds),
        (oscillator, ("--model", "preisach-oscillator", "--levels", 4)),
    ],
)
def test_prediction_of_the_same_file_has_the_errors_of_the_identification(bench, tmp_path, make, options):
    data, model, out = make(tmp_path), tmp_path / "model.json", tmp_path / "predicted.csv"
    code, _, text = bench("identify", data, *COLUMNS, *options, "--out", model, "--json", tmp_path / "fit.json")
    assert code == 0, text
    code, _, text = bench("predict", model, data, *COLUMNS, "--out", out, "--json", tmp_path / "predict.json")
    assert code == 0, text
    code, _, text = bench("model", "test", model, "--data", data, "--json", tmp_path / "compare.json")
    assert code == 0, text
    fit, predicted, compared = (
        json.loads((tmp_path / f"{name}.json").read_text()) for name in ("fit", "predict", "compare")
    )
    for key in ("max", "rms", "average", "rms_percent"):
        assert predicted[key] == pytest.approx(fit[key], rel=1e-9)
        assert compared["model"]["raw"][key] == pytest.approx(fit[key], rel=1e-9)
    assert fit["output_unit"] == "µm"
    assert fit["rms_percent"] < (0.6 if "rate-dependent-plays" in options else 25.0)


def test_the_functions_of_the_package_take_times(tmp_path):
    import bench

    data = hammerstein(tmp_path)
    options = {"time_column": "time", "levels": 5, "dynamics": "lag"}
    found = bench.identify(data, "hammerstein", input="drive", output="response", **options)
    table = np.loadtxt(data, delimiter=",", skiprows=1)
    predicted = bench.predict(found, table[:, 1], times=1e-3 * table[:, 0])
    np.testing.assert_allclose(table[:, 2] - predicted, found.identification.residuals, atol=1e-12)
    with pytest.raises(ConfigurationError, match="give --time COLUMN"):
        bench.predict(found, table[:, 1])


def test_time_stands_in_rows_figures_and_card(bench, tmp_path):
    data, model, card = hammerstein(tmp_path), tmp_path / "model.json", tmp_path / "card.md"
    options = ("--model", "hammerstein", "--levels", 5, "-o", "dynamics=lag", "--figures", tmp_path / "figures")
    code, _, text = bench("identify", data, *COLUMNS, *options, "--out", model, "--card", card)
    assert code == 0, text
    assert (tmp_path / "figures" / "hammerstein-errors.png").is_file()
    times, drive, _ = np.loadtxt(data, delimiter=",", skiprows=1, unpack=True)
    rates = np.abs(np.diff(drive) / np.diff(1e-3 * times))
    steps = 1e-3 * np.diff(times)
    page = card.read_text(encoding="utf-8")
    slowest, fastest = json.loads(model.read_text(encoding="utf-8"))["validity"]["rates"]
    assert rates.min() < slowest < fastest < rates.max()
    assert f"{slowest:.4g} to {fastest:.4g} V/s" in page
    assert (
        f"| sampling rate | {1.0 / np.median(steps):.4g} Hz over {1e-3 * np.ptp(times):.4g} s; uneven steps" in page
    )
    rows = {name: tmp_path / f"{name}.csv" for name in ("predict", "compare")}
    assert bench("predict", model, data, *COLUMNS, "--out", rows["predict"])[0] == 0
    assert bench("model", "test", model, "--data", data, "--out", rows["compare"])[0] == 0
    for path in rows.values():
        head = path.read_text(encoding="utf-8").splitlines()[0]
        assert head == "time [s],drive [V],measured [µm],predicted [µm],residual [µm]"
        written = np.loadtxt(path, delimiter=",", skiprows=1, usecols=0)
        np.testing.assert_allclose(written, 1e-3 * times, rtol=1e-12)


def test_smoothing_is_chosen_by_cross_validation_and_refused_where_there_is_none(bench, tmp_path):
    data, summary = hammerstein(tmp_path), tmp_path / "fit.json"
    options = ("--model", "hammerstein", "--levels", 12, "-o", "dynamics=lag", "--cross-validate")
    code, out, text = bench("identify", data, *COLUMNS, *options, "--json", summary)
    assert code == 0, text
    assert "on blocks left out" in " ".join(out.split())
    assert json.loads(summary.read_text())["smoothing"] > 0.0
    for model, option, words in (
        ("hammerstein", "-oridge=0.1", "takes no -o ridge"),
        ("rate-dependent-plays", "--cross-validate", "takes no --smoothing"),
        ("preisach-oscillator", "--smoothing=0.1", "takes no --smoothing"),
        ("hammerstein", "--levels=5,10", "takes one number"),
    ):
        code, _, text = bench("identify", data, *COLUMNS, "--model", model, option)
        assert (code, words in " ".join(text.split())) == (2, True), text


def test_what_does_not_fit_together_is_refused_with_the_option(bench, tmp_path):
    data, model = hammerstein(tmp_path), tmp_path / "model.json"
    without = COLUMNS[2:]
    nameless = tmp_path / "nameless.csv"
    nameless.write_text(Path(data).read_text(encoding="utf-8").replace("time [ms]", "row"), encoding="utf-8")
    code, _, text = bench("identify", nameless, *without, "--model", "hammerstein")
    assert (code, "needs the time of each row: give --time COLUMN, or --format interval=TIME" in text) == (2, True)
    code, _, text = bench("identify", data, *without, "--time", "none", "--model", "hammerstein")
    assert (code, "needs the time of each row: give --time COLUMN" in text) == (2, True)
    code, _, text = bench("identify", data, *COLUMNS, "--model", "preisach")
    assert (code, "--time: preisach is a model without time" in text.replace("\n", " ")) == (2, True)
    code, _, text = bench("identify", data, *COLUMNS, "--model", "hammerstein", "-o", "dynamics=echo")
    assert (code, "kelvin-voigt" in text) == (2, True)
    code, _, text = bench("identify", data, *without, "--time", "drive", "--model", "hammerstein")
    assert code != 0
    assert "column drive is in V" in text
    assert bench("identify", data, *COLUMNS, "--model", "hammerstein", "-o", "dynamics=lag", "--out", model)[0] == 0
    code, _, text = bench("predict", model, nameless, *without, "--out", tmp_path / "p.csv")
    assert (code, "give --time COLUMN" in text) == (2, True)
    code, _, text = bench("predict", model, data, *COLUMNS, "--out", tmp_path / "p.csv", "--initial", "rest")
    assert (code, "negative, positive, skip" in text.replace("\n", " ")) == (2, True)
    swapped = tmp_path / "swapped.csv"
    write(swapped, [0, 1, 3, 2, *range(4, 14)], np.arange(14.0), np.arange(14.0))
    for columns in (COLUMNS, without):
        code, _, text = bench("identify", swapped, *columns, "--model", "hammerstein")
        assert code != 0
        assert "does not increase in row 4" in text.replace("\n", " ")


def test_a_column_named_time_and_that_of_the_model_need_not_be_given(bench, tmp_path):
    data, model, errors = hammerstein(tmp_path), tmp_path / "model.json", tmp_path / "errors.json"
    clocked = tmp_path / "clocked.csv"
    clocked.write_text(Path(data).read_text(encoding="utf-8").replace("time", "clock"), encoding="utf-8")
    without = COLUMNS[2:]
    for file, time in ((data, ()), (clocked, ("--time", "clock"))):
        code, _, text = bench(
            "identify", file, *without, *time, "--model", "hammerstein", "-o", "dynamics=lag", "--out", model,
            "--json", errors,
        )  # fmt: skip
        assert code == 0, text
        found = json.loads(errors.read_text())["rms"]
        # Its own column comes first, then one so named.
        for other in (data, clocked) if time else (data,):
            code, _, text = bench("predict", model, other, *without, "--out", tmp_path / "p.csv", "--json", errors)
            assert code == 0, text
            assert json.loads(errors.read_text())["rms"] == pytest.approx(found, rel=1e-9)


def test_a_drift_is_of_its_own_record_and_a_session_is_recalibrated(bench, tmp_path):
    """Another session has no drift, another zero and a gain of 1.1."""
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(5e-4, 2e-3, 400))
    first, second = (5.0 + 5.0 * np.sin(2.0 * np.pi * f * t) * (1.0 - t) for f in (12.0, 9.0))
    model = Hammerstein(Preisach(uniform_levels(0.0, 10.0, 5), rng.random(15)), LinearPart(0.0, (0.004, 0.0)))
    drifting = write(tmp_path / "first.csv", 1e3 * t, first, model.evaluate(t, first) + 4.0 * t)
    later = write(tmp_path / "second.csv", 1e3 * t, second, 2.0 + 1.1 * model.evaluate(t, second))
    out, errors, without = tmp_path / "model.json", tmp_path / "errors.json", COLUMNS[2:]
    code, _, text = bench(
        "identify", drifting, *without, "--model", "hammerstein", "--levels", 5, "-o", "dynamics=lag,drift",
        "--out", out,
    )  # fmt: skip
    assert code == 0, text
    found = {}
    for file, options in (
        (drifting, ()),
        (later, ()),
        (later, ("--recalibrate", "offset,gain,drift", "--recalibrate-rows", 300)),
    ):
        code, _, text = bench("predict", out, file, *without, *options, "--out", tmp_path / "p.csv", "--json", errors)
        assert code == 0, text
        warned = "which is that of its own record" in " ".join(text.split())
        assert warned is (file == later and not options)
        found[file, options] = json.loads(errors.read_text())
    mended = found[later, options]
    assert mended["rms"] < 0.1 * found[later, ()]["rms"]
    assert mended["recalibration"]["gain"]["value"] == pytest.approx(1.1, rel=0.01)
    code, shown, text = bench("model", "test", out, "--data", later)
    assert code == 0
    assert "that of its own record" in " ".join((shown + text).split())
    code, _, text = bench("model", "test", out, "--data", later, *options, "--json", errors)
    assert code == 0, text
    assert json.loads(errors.read_text())["model"]["recalibrated"]["rms"] == pytest.approx(mended["rms"], rel=1e-6)


def test_rate_dependent_plays_are_identified_inverted_and_go_on_from_their_memory(bench, tmp_path):
    data, model, wanted = plays(tmp_path), tmp_path / "model.json", tmp_path / "wanted.csv"
    code, _, text = bench(
        "identify", data, *COLUMNS, "--model", "rate-dependent-plays", "--out", model, "--card", tmp_path / "card.md"
    )
    assert code == 0, text
    assert "time constant 1" in (tmp_path / "card.md").read_text(encoding="utf-8")
    times, _, response = np.loadtxt(data, delimiter=",", skiprows=1, unpack=True)
    lead = np.linspace(response[-1], 4.0, 40)
    rows = np.column_stack([times[-1] + 1.5 * np.arange(1.0, 41.0), lead])
    np.savetxt(wanted, rows, delimiter=",", header="time [ms],response [um]", comments="", fmt="%.17g")
    setpoints, predicted = tmp_path / "setpoints.csv", tmp_path / "predicted.csv"
    options = ("--continue-memory", "--time", "time")
    code, out, text = bench("invert", model, wanted, *options, "--column", "response", "--out", setpoints)
    assert code == 0, text
    assert "40 met" in out
    code, _, text = bench("predict", model, setpoints, *options, "--input", "setpoint", "--out", predicted)
    assert code == 0, text
    np.testing.assert_allclose(np.loadtxt(predicted, delimiter=",", skiprows=1)[:, 2], lead, atol=1e-9)
    _, shown, _ = bench("show", "rate-dependent-plays")
    assert "inverse: exact" in shown
    assert "time_constants" in shown
