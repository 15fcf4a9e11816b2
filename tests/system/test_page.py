"""The page of a run, opened in a browser: it holds all that the record says, and asks for nothing from anywhere."""

import io
from pathlib import Path

import pytest
from cases import cases
from drawn_figures import looking_at_figures
from rich.console import Console
from written_run import HOSTILE, META, write_run

from bench.analysis import Published, report_run
from bench.api import identify
from bench.record import add_model


@pytest.fixture(scope="module")
def opened(browser):
    """Open a page without a network; return the text of its sections by title, the requests, and the page."""

    def open_(path):
        page = browser.new_page()
        asked = []

        def answer(route):
            asked.append(route.request.url)
            route.continue_() if route.request.url == path.as_uri() else route.abort()

        page.route("**/*", answer)
        problems = []
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.on("dialog", lambda dialog: problems.append(dialog.message))
        page.goto(path.as_uri())
        page.evaluate("document.querySelectorAll('details').forEach(each => { each.open = true })")
        assert asked == [path.as_uri()]
        assert problems == []
        sections = {each.get_attribute("id"): each.inner_text() for each in page.query_selector_all("section")}
        return sections, page

    return open_


@pytest.fixture(scope="module")
def reported(tmp_path_factory):
    folder = write_run(tmp_path_factory.mktemp("runs") / "run")
    found = identify(folder, input="plate", output="tip", model="preisach", levels=8, band=True)
    for name in ("preisach", "a model with a name that is longer than any legend has room for in one line"):
        add_model(folder, name, 1.0, found.file.to_json())
    published = Published("loops", "largest error", "1.5", "µm", "Fig. 3", ("models", "preisach", "max"), scale=1e6)
    other = Published("tracking", "of another protocol", "1", "", "Fig. 9")
    with looking_at_figures() as drawn:
        result = report_run(folder, (), None, Console(file=io.StringIO()), published=(published, other))
    return folder, result, drawn


@pytest.fixture(scope="module")
def page(reported, opened):
    sections, page = opened(reported[0] / "report.html")
    yield sections, page
    page.close()


class TestPageOfARun:
    def test_it_is_small(self, reported):
        assert Path(reported[1]["page"]).stat().st_size < 1_000_000

    def test_every_figure_shows_something_and_nothing_is_covered_or_cut_off(self, reported):
        assert len(reported[2]) > 4
        assert {name: problems for name, problems in reported[2].items() if problems} == {}

    def test_it_says_in_words_what_happened(self, page):
        text = page[0]["summary"]
        assert "Drive the plate through loops" in text
        assert "completed after 1000 of 1000 steps" in text
        assert "confirmed the safe state" in text
        assert "Interlocks acted 1 times" in text
        assert "Errors of the model preisach: max " in text

    @cases(
        ("section", "words"),
        [
            ("parameters", ["high", "80", "set", "emulation.noise", "drive"]),
            ("devices-and-calibration", ["TEC-1", "15 to 95", "2025-03-01", "2026-03-01: overdue", "gain", "2.5"]),
            ("interlocks-and-margins", ["≤ 100 °C, for 2 s", "20.", "safe", "equal readings for 60 s", "warn", "1"]),
            ("phases", ["rise", "decay", "1:06:40", "1:06:40", "500"]),
            ("signals", ["plate_setpoint", "least margin", "µm"]),
            ("loops-and-models", ["RMS / % of range", "prediction band of preisach", "90 %", "covers"]),
            ("loops-and-models", ["coefficients of preisach", "σ from the residuals", "bias", "density at β"]),
            ("loops-and-models", ["standard uncertainty", "cells swept"]),
            ("numbers-of-the-paper", ["largest error", "1.5", "µm", "Fig. 3"]),
            ("real-time", ["1000 recorded samples", "greatest", "0.600", "hold: 17 samples at 100 Hz, 2 left out"]),
            ("events", ["rise", "stands still", "WARN"]),
            ("how-to-repeat-it", ["bench run --from", "bench run loops --set", "0123456789ab", "numpy"]),
        ],
    )
    def test_a_section_holds_what_is_listed(self, page, section, words):
        for word in words:
            assert word in page[0][section]

    def test_numbers_of_another_protocol_are_left_out(self, page):
        assert "of another protocol" not in "".join(page[0].values())

    def test_figures_are_drawn_with_their_texts(self, page):
        figures = page[1].query_selector_all("figure svg")
        texts = [figure.text_content() for figure in figures]
        assert any("measured" in text and "residual" in text and "prediction band" in text for text in texts)
        assert any("density" in text and "σ of the density" in text for text in texts)
        assert any("memory curve at the end" in text for text in texts)
        assert any("lateness / ms" in text for text in texts)
        assert all(figure.bounding_box()["height"] > 100 for figure in figures)

    def test_names_are_escaped(self, page):
        assert "taken" not in page[1].title()[:10]
        assert page[1].query_selector_all("script, img") == []
        assert HOSTILE in page[1].query_selector("h1").inner_text()
        assert HOSTILE in page[0]["phases"]


def test_an_unfinished_run_is_what_there_is_and_marked(tmp_path, opened):
    folder = write_run(tmp_path / "run", steps=20, finished=False)
    console = Console(file=io.StringIO(), width=200)
    result = report_run(folder, (), None, console)
    assert result["status"] == "unfinished"
    sections, page = opened(folder / "report.html")
    assert page.query_selector(".badge").inner_text() == "unfinished"
    assert "UNFINISHED" in sections["summary"]
    assert "20 of 1000 steps" in sections["summary"]
    page.close()


def test_a_run_without_a_step_has_a_page(tmp_path):
    folder = write_run(tmp_path / "run", steps=0, finished=False)
    report_run(folder, (), None, Console(file=io.StringIO()))
    assert "0 of 1000 steps" in (folder / "report.html").read_text()


def test_two_runs_have_a_page(tmp_path, opened, bench):
    folders = [
        write_run(tmp_path / "first", steps=30),
        write_run(tmp_path / "second", steps=40, meta={**META, "parameters": {"high": 81.0}}),
    ]
    code, out, _ = bench("runs", "compare", *folders, "--html", tmp_path / "both.html")
    assert code == 0
    assert "page:" in out
    sections, page = opened(tmp_path / "both.html")
    assert "parameters.high" in sections["what-differs"]
    assert "30 common steps" in sections["signals"]
    assert len(page.query_selector_all("figure svg")) == 2
    page.close()
