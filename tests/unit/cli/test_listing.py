"""`bench list` remembers what it shows, and makes it again when something that it is made of changes."""

import json
import os
import sys

import pytest

from bench.base import registry
from bench.cli import catalogue, listing


@pytest.fixture
def made(monkeypatch, tmp_path):
    """Count how often the catalogue is made, into a folder for caches of the test's own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path / "cache"))
    count = []
    installed = catalogue.installed
    monkeypatch.setattr(catalogue, "installed", lambda: count.append(1) or installed())
    return count


@pytest.fixture
def outside(tmp_path, monkeypatch):
    """A package that registers a study; return its module."""
    site = tmp_path / "site"
    info = site / "outside_listed-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: outside-listed\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[bench.studies]\nlisted = outside_listed:STUDY\n")
    module = site / "outside_listed.py"
    module.write_text("class STUDY:\n    summary = 'first'\n")
    monkeypatch.syspath_prepend(str(site))
    registry.forget()
    yield module
    sys.modules.pop("outside_listed", None)
    monkeypatch.undo()
    registry.forget()


def test_is_the_catalogue_and_made_once(made):
    first = listing.listing()
    assert len(made) == 1
    assert listing.listing() == first
    assert len(made) == 1
    assert first == json.loads(json.dumps(catalogue.installed()))


def test_is_made_anew_after_a_change_of_a_file(made, outside):
    assert listing.listing()["packages"] == {"listed": "outside-listed"}
    os.utime(outside, (1.0, 1.0))
    listing.listing()
    listing.listing()
    assert len(made) == 2


def test_is_made_anew_without_a_package(made, outside):
    assert "listed" in listing.listing()["studies"]
    (outside.parent / "outside_listed-1.0.dist-info" / "entry_points.txt").unlink()
    registry.forget()
    assert "listed" not in listing.listing()["studies"]
    assert len(made) == 2


def test_a_problem_is_not_remembered(made, outside):
    outside.write_text("raise OSError('not today')\n")
    for _ in range(2):
        assert "not today" in listing.listing()["problems"][0]
    assert len(made) == 2


@pytest.mark.parametrize("damage", ["", "null", "{}", '{"state": 1}'])
def test_what_is_damaged_is_made_anew(made, damage):
    first = listing.listing()
    (file,) = listing._folder().glob("catalogue-*.json")
    file.write_text(damage)
    assert listing.listing() == first
    assert listing.listing() == first
    assert len(made) == 2


def test_another_environment_has_a_listing_of_its_own(made, monkeypatch, tmp_path):
    listing.listing()
    with monkeypatch.context() as elsewhere:
        elsewhere.setattr(sys, "prefix", str(tmp_path))
        listing.listing()
    listing.listing()
    assert len(made) == 2


def test_a_folder_that_cannot_be_written_is_done_without(made, tmp_path):
    (tmp_path / "cache").write_text("a file")
    assert listing.listing() == listing.listing()
    assert len(made) == 2
