"""What the tests of records share."""

import tempfile

import pytest


@pytest.fixture
def other_disk(tmp_path_factory, monkeypatch):
    """A folder for temporary files of the test's own."""
    folder = tmp_path_factory.mktemp("temporary")
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder
