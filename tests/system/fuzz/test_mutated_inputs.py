"""A few mutated inputs of every kind, and that what goes wrong with one is noticed."""

import random

import commands
import mutated_data
import pytest
from mutated_inputs import all_kinds, try_input
from mutations import mutated_bytes, mutated_document, mutated_lines, objections

from bench.record import Record

# What reads the files of libraries is a process of its own.
pytestmark = pytest.mark.usefixtures("warm_popen")

FEW = 3
"""Inputs of each kind; tools/mutated_inputs.py tries thousands."""


@pytest.mark.parametrize("kind", all_kinds())
def test_no_input_does_harm(kind, tmp_path):
    for number in range(FEW):
        folder = tmp_path / str(number)
        folder.mkdir()
        assert try_input(kind, number, 0, folder) == ""


def test_the_same_seed_gives_the_same_inputs():
    text = "a,b\n" + "".join(f"{i},{0.5 * i}\n" for i in range(20))
    document = {"a": [1.0, 2.0], "b": {"c": "text", "d": 3}}
    for mutate, given in ((mutated_lines, text), (mutated_bytes, text.encode()), (mutated_document, document)):
        first, again = ([repr(mutate(given, random.Random(seed))) for seed in range(50)] for _ in range(2))
        assert first == again
        assert len(set(first)) > 25


@pytest.mark.parametrize(
    "changed", [{"a": True}, {"a": "x"}, {"a": None}, {"a": float("nan")}, {"a": [1.0]}, {"a": 1.0, "b": 1.0}, []]
)
def test_what_a_strict_reader_refuses(changed):
    assert [*objections({"a": 2.0}, {"a": 3}), *objections({"a": [2.0]}, {"a": [3.5, 4.5]})] == []
    assert [*objections({"a": 2.0}, changed)]


def damaged(kind, tmp_path):
    """Yield what is wrong with inputs of a kind."""
    for number in range(30):
        folder = tmp_path / str(number)
        folder.mkdir()
        yield try_input(kind, number, 0, folder)


def test_a_row_that_is_not_read_is_noticed(tmp_path, monkeypatch):
    cells_of = mutated_data.cells_of
    monkeypatch.setattr(
        mutated_data, "cells_of", lambda *given: [*cells_of(*given), ["99.5", "99.5", "99.5"], ["1.5", "1.5", "1.5"]]
    )
    assert any("are read" in wrong for wrong in damaged("text", tmp_path))


def test_a_number_that_changes_is_noticed(tmp_path, monkeypatch):
    steps = Record.steps

    def changed(record):
        table = steps(record)
        table["u"][3] += 1e-9
        return table

    monkeypatch.setattr(Record, "steps", changed)
    assert any("is not in the file" in wrong for wrong in damaged("text", tmp_path))


def test_a_traceback_is_noticed(tmp_path, monkeypatch):
    def fail(*_, **__):
        raise RuntimeError("a defect")

    monkeypatch.setattr("bench.analysis.tables.imported.read_dataset", fail)
    assert any("a defect" in wrong for wrong in damaged("text", tmp_path))


@pytest.mark.parametrize(
    ("code", "out", "err"),
    [
        (2, "", ""),
        (0, "", "Traceback"),
        (0, "\x1b[2J", ""),
        (-11, "", "x"),
        (77, "", "x"),
        (0, "", "/lib/a.py:3: RuntimeWarning: overflow"),
    ],
)
def test_an_unclear_end_of_a_command_is_noticed(code, out, err):
    with pytest.raises(commands.UnclearError):
        commands.checked(commands.Ended(code, out, err))
