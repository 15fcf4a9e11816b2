"""How far long work is: said where it computes, shown after a while."""

import gzip
import io

import numpy as np
from rich.console import Console

from bench.analysis import read_columns
from bench.base import say_share, shares_to
from bench.base.patience import PatienceDisplay
from bench.identification import damped_oscillation, identify


def collected(work):
    """The shares that are said while something is done."""
    found = []
    with shares_to(lambda what, share: found.append((what, share))):
        work()
    return found


def test_reading_says_how_far_it_is(tmp_path):
    text = "a,b\n" + "".join(f"{n},1\n" for n in range(100_000))
    (tmp_path / "a.csv").write_text(text)
    with gzip.open(tmp_path / "b.csv.gz", "wt") as file:
        file.write(text)
    for name in ("a.csv", "b.csv.gz"):
        found = collected(lambda name=name: read_columns(tmp_path / name, ["a"]))
        assert {what for what, _ in found} == {"reading"}
        # The last pass is over all the data.
        assert [share for _, share in found[-3:]] == sorted(share for _, share in found[-3:])
        assert found[-1][1] == 1.0


def test_fitting_says_how_far_it_is():
    inputs = damped_oscillation(-1.0, 1.0, 0.0, 20, 0.05)
    outputs = np.tanh(3.0 * inputs) + 0.02 * np.random.default_rng(0).standard_normal(inputs.size)
    found = collected(lambda: identify("preisach", inputs, outputs, levels=20))
    assert {what for what, _ in found} == {"fitting"}
    shares = [share for _, share in found]
    assert len(shares) > 5
    assert 0.0 <= shares[0] < max(shares) <= 1.0


def test_nobody_has_to_listen():
    say_share("fitting", 0.5)
    assert collected(lambda: say_share("fitting", 2.0)) == [("fitting", 1.0)]


def test_the_bar_has_stage_and_remaining_time():
    screen = io.StringIO()
    display = PatienceDisplay("data.csv", Console(file=screen, force_terminal=True, width=100), patience=0.0)
    display.start()
    display.say("reading", 0.5)
    display.say("reading", 0.25)
    display.say("fitting", 0.75)
    display.stop()
    assert "data.csv: fitting" in screen.getvalue()
    assert "left, about" in screen.getvalue()


def test_work_that_is_done_soon_shows_nothing():
    screen = io.StringIO()
    display = PatienceDisplay("data.csv", Console(file=screen, force_terminal=True), patience=1000.0)
    display.start()
    display.say("reading", 0.5)
    display.stop()
    assert screen.getvalue() == ""
