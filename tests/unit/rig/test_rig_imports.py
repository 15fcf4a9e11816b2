"""A rig file is code: it may have modules of the bench, of registered packages, and those beside it imported."""

import sys

import pytest

from bench.base import ConfigurationError
from bench.rig import load_rig

TRACE = "from pathlib import Path\nPath(__file__).with_suffix('.ran').touch()\n"


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """A folder on the search path, beside that of the rig files."""
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    monkeypatch.setattr(sys, "path", [str(folder), *sys.path])
    return folder


def rig(folder, name, driver):
    folder.mkdir(exist_ok=True)
    file = folder / f"{name}.toml"
    file.write_text(f'extends = "vo2"\n[devices.tec]\ndriver = "{driver}"\n')
    return str(file)


@pytest.mark.parametrize("where", ["module", "package"])
def test_a_module_that_nobody_registered_does_not_run(elsewhere, tmp_path, where):
    name = f"stray_{where}"
    if where == "package":
        (elsewhere / name).mkdir()
    file = elsewhere / name / "__init__.py" if where == "package" else elsewhere / f"{name}.py"
    file.write_text(TRACE)
    with pytest.raises(ConfigurationError) as caught:
        load_rig(rig(tmp_path / "rigs", "stray", f"{name}:Driver"))
    message = str(caught.value)
    assert len(message.splitlines()) == 1
    for words in (f"devices.tec.driver = '{name}:Driver'", str(elsewhere), "beside the rig file", "bench.devices"):
        assert words in message
    assert not file.with_suffix(".ran").exists()
    assert name not in sys.modules


def test_of_the_standard_library_as_little(tmp_path):
    with pytest.raises(ConfigurationError, match=r"module antigravity .* may not be imported"):
        load_rig(rig(tmp_path / "rigs", "fly", "antigravity:Driver"))
    assert "antigravity" not in sys.modules


def test_nor_by_an_override(elsewhere):
    (elsewhere / "stray_override.py").write_text(TRACE)
    with pytest.raises(ConfigurationError, match="may not be imported"):
        load_rig("vo2", {"emulation.laboratory": "stray_override:Laboratory"})
    assert not (elsewhere / "stray_override.ran").exists()


def test_beside_the_rig_file_and_beside_that_which_it_extends(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", [*sys.path])
    base, own = tmp_path / "base", tmp_path / "own"
    for folder, name in ((base, "imports_base"), (own, "imports_own")):
        folder.mkdir()
        (folder / f"{name}.py").write_text("from drivers.meerstetter import MeerstetterTEC as Driver\n")
    below = rig(base, "below", "imports_base:Driver")
    assert load_rig(below).devices[0].driver.__name__ == "MeerstetterTEC"
    (own / "above.toml").write_text('extends = "../base/below.toml"\n[devices.tec]\ndriver = "imports_own:Driver"\n')
    assert load_rig(str(own / "above.toml")).devices[0].driver.__name__ == "MeerstetterTEC"


def test_a_module_of_the_bench_that_is_not_registered_by_name():
    file = load_rig("vo2", {"devices.tec.driver": "drivers.meerstetter.tec:MeerstetterTEC"})
    assert file.devices[0].driver.__name__ == "MeerstetterTEC"
