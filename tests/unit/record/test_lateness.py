import pytest

from bench.record import Lateness, lateness_lines
from bench.record.lateness import EDGES


def test_each_sample_is_in_one_bin():
    found = Lateness(100.0)
    for late in (-1.0, 0.0, 1e-4, 1.1e-4, 3e-3, 5.0):
        found.add(late)
    found.add(0.3, count=4)
    content = found.to_json()
    assert content["samples"] == sum(content["counts"]) == 10
    assert content["counts"][0] == 3
    assert content["counts"][1] == 1
    assert content["counts"][EDGES.index(5e-3)] == 1
    assert content["counts"][EDGES.index(0.5)] == 4
    assert content["counts"][-1] == 1
    assert content["worst"] == 5.0
    assert content["mean"] == pytest.approx((1e-4 + 1.1e-4 + 3e-3 + 5.0 + 1.2) / 10)


def test_loops_of_one_kind_are_one():
    first, second = Lateness(100.0, left_out=2), Lateness(100.0, left_out=1)
    first.add(0.001)
    second.add(0.1, count=3)
    first.merge(second)
    assert (first.samples, first.left_out, first.worst) == (4, 3, 0.1)


def test_as_text():
    found = Lateness(100.0, left_out=3)
    found.add(0.0, count=30)
    found.add(1.5e-4, count=10)
    assert [*lateness_lines({"hold": found.to_json()})] == [
        "lateness of hold: 40 samples at 100 Hz, 3 left out; mean 0.0375 ms, worst 0.15 ms",
        "    ≤ 0.1 ms        30  ████████████████████████████████████████",
        "    ≤ 0.2 ms        10  █████████████",
    ]
    assert [*lateness_lines({})] == []
