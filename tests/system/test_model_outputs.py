"""What the commands about models write beside what they print: rows as CSV, figures, model cards."""

import csv
import hashlib
import json
import re
import shlex

import numpy as np
import pytest
from cases import cases
from matplotlib.figure import Figure

from bench import identify
from bench.analysis import (
    ColumnNames,
    compare_models,
    draw_comparison,
    draw_identification,
    errors_text,
    load_models,
    read_columns,
    read_dataset,
    write_card,
)
from bench.analysis.report.model_card import sha256_of
from bench.base import DataError

COLUMNS = ("--input", "voltage", "--output", "displacement")
NAMES = {"input": "voltage", "output": "displacement"}


@pytest.fixture(scope="module")
def loop(tmp_path_factory):
    """A file of shrinking loops of a play."""
    path = tmp_path_factory.mktemp("data") / "loop.csv"
    inputs = 5 * np.sin(np.linspace(0, 6 * np.pi, 300)) * np.linspace(1, 0.2, 300)
    play, outputs = 0.0, []
    for value in inputs:
        play = min(max(play, value - 1.0), value + 1.0)
        outputs.append(play + 0.2 * value)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["time [s]", "voltage [V]", "displacement [µm]"])
        writer.writerows(zip(0.5 * np.arange(300.0), inputs, outputs, strict=True))
    return path


@pytest.fixture(scope="module")
def models(loop):
    """A model with a plane and one without, in files."""
    paths = {}
    for name, options in (("preisach", {"levels": 8}), ("polynomial", {"degree": 3})):
        paths[name] = loop.parent / f"{name}.json"
        identify(loop, name, **NAMES, **options).file.save(paths[name])
    return paths


@pytest.fixture
def drawn(monkeypatch):
    """The axes of every figure that is saved, by the name of its file."""
    found = {}
    save = Figure.savefig

    def keep(self, path, **options):
        found[path.name] = self.axes
        save(self, path, **options)

    monkeypatch.setattr(Figure, "savefig", keep)
    return found


def texts_of(axes):
    """The legend of axes."""
    return [text.get_text() for text in axes.get_legend().get_texts()]


def assert_labelled(all_axes):
    """The lowest of the panels has a label below it, and each has one beside it that names its unit."""
    assert all_axes[-1].get_xlabel()
    for axes in all_axes:
        assert axes.get_ylabel().endswith(("/ µm", "/ V", "/ µm/V²"))


class TestRows:
    def test_rows_have_what_was_printed(self, bench, tmp_path, loop, models):
        out, result = tmp_path / "out.csv", tmp_path / "out.json"
        code, text, err = bench("predict", models["preisach"], loop, *COLUMNS, "--out", out, "--json", result)
        assert code == 0, err
        rows = read_columns(out, ["voltage", "measured", "predicted", "residual"])
        assert set(rows.units.values()) == {"V", "µm"}
        residual = rows.values["residual"]
        np.testing.assert_array_equal(residual, rows.values["measured"] - rows.values["predicted"])
        rms = float(np.sqrt(np.mean(residual**2)))
        assert json.loads(result.read_text())["rms"] == rms
        assert f"{rms:.4g} µm" in text

    def test_inputs_alone_are_predicted_too(self, bench, tmp_path, loop, models, drawn):
        code, _, err = bench(
            "predict", models["preisach"], loop, "--input", "2", "--out", tmp_path / "o.csv",
            "--figures", tmp_path / "figures",
        )  # fmt: skip
        assert code == 0, err
        assert (tmp_path / "o.csv").read_text().splitlines()[0] == "2 [V],predicted [µm]"
        assert list(drawn) == ["preisach-loops.png"]
        assert_labelled(drawn["preisach-loops.png"])

    def test_compared_rows_give_the_compared_errors(self, bench, tmp_path, loop, models):
        out, result = tmp_path / "out.csv", tmp_path / "out.json"
        code, _, err = bench(
            *("model", "test", *models.values(), "--data", loop, "--skip", 40, "--out", out, "--json", result)
        )
        assert code == 0, err
        compared = json.loads(result.read_text())
        for name in models:
            residual = read_columns(out, [f"{name} residual"]).values[f"{name} residual"]
            assert residual.size == 300
            assert np.abs(residual[40:]).max() == pytest.approx(compared[name]["raw"]["max"], rel=1e-12)

    def test_an_output_in_another_unit_is_refused(self, bench, tmp_path, loop, models):
        other = tmp_path / "other.csv"
        other.write_text(loop.read_text(encoding="utf-8").replace("µm", "mm"), encoding="utf-8")
        code, _, err = bench("predict", models["preisach"], other, *COLUMNS, "--out", tmp_path / "o.csv")
        assert code == 3
        assert "displacement is in mm" in err


class TestFigures:
    @pytest.mark.parametrize("model", ["preisach", "polynomial"])
    def test_a_fit_is_drawn_with_the_errors_of_the_text(self, tmp_path, loop, drawn, model):
        found = identify(loop, model, **NAMES, skip=60)
        paths = draw_identification(found, tmp_path / "figures")
        assert [path.name for path in paths] == list(drawn)
        errors = found.identification.errors
        for name in (f"{model}-loops.png", f"{model}-errors.png"):
            top, bottom = drawn[name]
            assert_labelled([top, bottom])
            assert texts_of(bottom) == [f"{model}: {errors_text(errors, 'µm')}"]
            assert "first 60 samples, not in the errors" in texts_of(top)
            # The last line but one is the residual that counts: no more than what the text says.
            counted = bottom.lines[-2].get_ydata()
            assert counted.size == 240
            assert np.abs(counted).max() == pytest.approx(errors.maximum, rel=1e-12)
        assert drawn[f"{model}-loops.png"][1].get_xlabel() == "voltage / V"
        assert drawn[f"{model}-errors.png"][1].get_xlabel() == "row"

    def test_cells_that_the_samples_of_the_fit_leave_out_are_hatched(self, tmp_path, loop, drawn):
        found = identify(loop, "preisach", **NAMES, skip=60)
        # The memory has swept them, the fit has not seen it.
        assert found.coverage.fraction == 1.0
        draw_identification(found, tmp_path)
        share = 1.0 - found.identification.certificate.coverage
        title = drawn["preisach-density.png"][0].get_title(loc="left")
        assert title == f"light grey: zero; hatched: never swept ({share:.0%})"
        assert share > 0.1

    def test_compared_models_share_their_figures(self, tmp_path, loop, models, drawn):
        compared = compare_models(
            load_models([*models.values()]), read_dataset([loop], ColumnNames(**NAMES)), skip=30
        )
        draw_comparison(compared, tmp_path)
        _, *residuals = drawn["models-errors.png"]
        assert [texts_of(axes)[0].partition(":")[0] for axes in residuals] == list(models)
        # Errors are compared on one scale.
        assert len({axes.get_ylim() for axes in residuals}) == 1
        assert len({axes.get_ylim() for axes in drawn["residuals.png"]}) == 1
        for axes, name in zip(drawn["residuals.png"], models, strict=True):
            shown = float(re.search(r"max (\S+),", axes.get_title(loc="left")).group(1))
            assert shown == pytest.approx(compared.comparisons[name].raw.maximum, rel=6e-3)

    def test_a_figure_that_cannot_be_written_is_named(self, tmp_path, loop):
        found = identify(loop, "polynomial", **NAMES)
        (tmp_path / "polynomial-loops.png").mkdir()
        with pytest.raises(DataError, match=r"polynomial-loops\.png cannot be written"):
            draw_identification(found, tmp_path)


class TestPlaces:
    @cases(
        ("options", "words"),
        [
            (["--out", "DIR/none/m.json"], ["--out", "no folder"]),
            (["--out", "DIR"], ["--out", "is a folder"]),
            (["--out", "DATA"], ["--out", "it is read"]),
            (["--card", "DIR/none/card.md"], ["--card", "no folder"]),
            (["--card", "DIR/x", "--out", "DIR/x"], ["--card", "that of --out"]),
            (["--figures", "DATA/figures"], ["--figures", "cannot be made"]),
            (["--json", "DATA"], ["--json", "it is read"]),
            (["--out", "DIR/x", "--json", "DIR/../DIRNAME/x"], ["--json", "that of --out"]),
        ],
    )
    def test_what_cannot_be_written_is_found_before_the_fit(self, bench, tmp_path, options, words):
        # Of a file that cannot be fitted: the options come first.
        data = tmp_path / "data.csv"
        data.write_text("voltage,displacement\n1,1\n")
        places = [
            text.replace("DIRNAME", tmp_path.name).replace("DIR", str(tmp_path)).replace("DATA", str(data))
            for text in options
        ]
        code, _, err = bench("identify", data, *COLUMNS, "--model", "preisach", *places)
        assert code in (2, 3)
        for word in words:
            assert word in err.replace("\n", " ")
        assert data.read_text() == "voltage,displacement\n1,1\n"


def read_card(path):
    """A card's sections by title: the rows of the table by their first cells, or the text."""
    found = {}
    for section in path.read_text(encoding="utf-8").split("\n## ")[1:]:
        title, _, text = section.partition("\n")
        lines = text.strip().splitlines()
        if lines[0].startswith("|"):
            rows = [re.split(r"(?<!\\)\|", line)[1:-1] for line in lines[2:]]
            found[title] = {key.strip(): [cell.strip() for cell in cells] for key, *cells in rows}
        else:
            found[title] = text.strip()
    return found


class TestCard:
    def test_a_card_has_what_the_fit_has(self, bench, tmp_path, loop):
        result = tmp_path / "fit.json"
        code, _, err = bench(
            "identify", loop, *COLUMNS, "--model", "preisach", "--levels", 6, "--plane", -6, 6, "--skip", 60,
            "--cross-validate", "--card", tmp_path / "card.md", "--figures", tmp_path / "figures", "--json", result,
            "--out", tmp_path / "model.json",
        )  # fmt: skip
        assert code == 0, err
        card, fit = read_card(tmp_path / "card.md"), json.loads(result.read_text())
        assert card["Data"]["SHA-256"] == [hashlib.sha256(loop.read_bytes()).hexdigest()]
        assert card["Data"]["rows"][0].startswith("300, of which the first 60 ")
        assert card["Data"]["output"][0].endswith("µm")
        assert card["Errors"]["RMS"] == [f"{fit['rms']:.4g}", f"{fit['rms_percent']:.2f}"]
        assert card["Errors"]["largest"] == [f"{fit['max']:.4g}", f"{fit['max_percent']:.2f}"]
        assert card["Certificate"]["coefficients"] == [f"{fit['passive']} free, {fit['active']} held at zero"]
        assert card["Limits of validity"]["inputs"][0].startswith(f"{fit['validity']['low']:.6g} to ")
        assert "negative saturation" in card["Limits of validity"]["memory before the first row"][0]
        assert "smoothing" in card["Selection"]
        for warning in fit["warnings"]:
            assert f"- {warning}" in card["Warnings"]
        for link in re.findall(r"\]\(<(.+?)>\)", card["Figures"]):
            assert (tmp_path / link).stat().st_size > 0

    def test_a_card_has_the_band_and_the_models_that_were_compared(self, bench, tmp_path, loop):
        result = tmp_path / "fit.json"
        code, _, err = bench(
            "identify", loop, *COLUMNS, "--model", "polynomial,prandtl-ishlinskii", "--time", "none", "--band",
            "--card", tmp_path / "card.md", "--json", result,
        )  # fmt: skip
        assert code == 0, err
        card, fit = read_card(tmp_path / "card.md"), json.loads(result.read_text())
        band = card["Prediction band"]
        assert band["level"] == ["90 %"]
        assert band["half-width"] == [f"{fit['band']['half_width']:.4g} µm"]
        compared = card["Models compared"]
        chosen = [row for row in fit["selection"]["table"] if row["note"] == "chosen"]
        marked = [key for key, cells in compared.items() if cells[-1] == "chosen"]
        assert len(marked) == 1
        assert marked[0].startswith(f"{chosen[0]['model']} {chosen[0]['options']}".strip())
        assert compared[marked[0]][0] == f"{chosen[0]['score']:.3g}"

    def test_a_card_has_what_the_held_out_errors_say_against_the_choice(self, bench, tmp_path, loop):
        code, _, err = bench(
            "identify", loop, *COLUMNS, "--model", "polynomial,polynomial-plays", "--train", "0:40", "--time", "none",
            "--card", tmp_path / "card.md", "--json", tmp_path / "fit.json",
        )  # fmt: skip
        assert code == 0, err
        advice = json.loads((tmp_path / "fit.json").read_text())["selection"]["advice"]
        said = [one["text"] for one in advice if one["code"] != "one-run"]
        assert said
        for text in said:
            assert text in " ".join(err.split())
            assert text in read_card(tmp_path / "card.md")["Warnings"]

    def test_its_command_identifies_the_same_model(self, bench, tmp_path, loop):
        bench(
            "identify", loop, *COLUMNS, "--model", "prandtl-ishlinskii", "-o", "plays=4", "-o",
            "origin=0.5", "--initial", "skip", "--card", tmp_path / "card.md", "--out", tmp_path / "model.json",
        )  # fmt: skip
        program, *words = shlex.split(read_card(tmp_path / "card.md")["Reproduce"].splitlines()[1])
        assert program == "bench"
        model = (tmp_path / "model.json").read_text()
        (tmp_path / "model.json").unlink()
        code, _, err = bench(*words)
        assert code == 0, err
        assert (tmp_path / "model.json").read_text() == model

    def test_a_model_without_memory_has_a_card(self, tmp_path, loop):
        found = identify(loop, "polynomial", **NAMES)
        write_card(tmp_path / "a|b.md", found, command="bench", model=None, figures=[])
        card = read_card(tmp_path / "a|b.md")
        assert "Figures" not in card
        assert card["Limits of validity"]["memory before the first row"][0].startswith("none")
        assert sha256_of(loop) == card["Data"]["SHA-256"][0]
        with pytest.raises(DataError, match=r"card\.md cannot be written"):
            write_card(tmp_path / "none" / "card.md", found, command="bench", model=None, figures=[])


@pytest.mark.parametrize("command", [("predict",), ("model", "test")])
def test_errors_that_stand_in_the_first_rows_are_told_with_the_option_that_leaves_them_out(
    bench, loop, models, tmp_path, command
):
    rows = loop.read_text(encoding="utf-8").splitlines()
    for row in range(1, 5):
        time, voltage, displacement = rows[row].split(",")
        rows[row] = f"{time},{voltage},{float(displacement) + 10.0 - row}"
    moved = tmp_path / "moved.csv"
    moved.write_text("\n".join(rows), encoding="utf-8")
    for file, skip, is_told in ((moved, 0, True), (moved, 4, False), (loop, 0, False)):
        given = (models["preisach"], file) if command == ("predict",) else (models["preisach"], "--data", file)
        out = ("--out", tmp_path / "rows.csv", "--skip", skip)
        code, _, err = bench(*command, *given, *COLUMNS, *out)
        assert code == 0, err
        text = " ".join(err.split())
        assert ("largest errors stand in the first 4 rows" in text) is is_told
        assert ("--skip 4 leaves them out" in text) is is_told
