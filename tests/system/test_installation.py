"""The bench installed from its distributions in a clean environment, without the checkout and without a network."""

import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("bench", "drivers", "sim_devices", "protocols", "rigs")
BUILD = "import sys; from setuptools import build_meta; build_meta.build_{}(sys.argv[1])"
REMARKS = {".pyc", ".nbi", ".nbc"}
"""Endings of files that Python and numba write beside sources."""


def done(command, folder, environment=None):
    result = subprocess.run(
        list(map(str, command)),
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=1100,
        check=False,
    )
    assert result.returncode == 0, (command, result.stdout[-2000:], result.stderr[-2000:])
    return result.stdout


def files_of(folder):
    return {
        path.relative_to(folder).as_posix()
        for package in PACKAGES
        for path in (folder / package).rglob("*")
        if path.is_file() and path.suffix not in REMARKS
    }


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Build the source distribution from a copy of the checkout, and the wheel from that; return the wheel."""
    home = tmp_path_factory.mktemp("built")
    source = home / "source"
    for package in PACKAGES:
        shutil.copytree(ROOT / package, source / package, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    done([sys.executable, "-c", BUILD.format("sdist"), home], source)
    (archive,) = home.glob("*.tar.gz")
    with tarfile.open(archive) as opened:
        opened.extractall(home / "unpacked", filter="data")
    (unpacked,) = (home / "unpacked").iterdir()
    assert files_of(unpacked) == files_of(ROOT)
    done([sys.executable, "-c", BUILD.format("wheel"), home], unpacked)
    (built,) = home.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def environment(wheel, tmp_path_factory):
    """Install the wheel in a new environment that sees the libraries of this one; return `bench` and variables."""
    home = tmp_path_factory.mktemp("clean")
    done([sys.executable, "-m", "venv", "--without-pip", home / "env"], home)
    python = home / "env" / "bin" / "python"
    options = ("--quiet", "--no-index", "--no-deps", "--no-compile", "--disable-pip-version-check")
    done([sys.executable, "-m", "pip", "--python", python, "install", *options, wheel], home)
    site = Path(done([python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"], home).strip())
    # Its folder only: what is installed there from the checkout is not run as a folder of this path.
    (site / "libraries.pth").write_text(sysconfig.get_path("purelib") + "\n")
    variables = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL"))}
    return home / "env" / "bin" / "bench", {**variables, "XDG_CACHE_HOME": str(home), "COLUMNS": "80"}


def test_the_wheel_has_every_file_of_the_packages(wheel):
    with zipfile.ZipFile(wheel) as opened:
        names = {name for name in opened.namelist() if ".dist-info/" not in name}
    assert names == files_of(ROOT)


def test_it_runs_without_the_checkout(environment, tmp_path):
    bench, variables = environment
    where = "import bench, drivers, rigs; print(bench.__file__, drivers.__file__, rigs.__file__)"
    for place in done([bench.parent / "python", "-c", where], tmp_path, variables).split():
        assert Path(place).is_relative_to(bench.parents[1])
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    assert done([bench, "--version"], tmp_path, variables) == f"bench {version}\n"
    listed = done([bench, "list"], tmp_path, variables)
    for name in ("vo2", "damped-oscillation", "preisach-nonmonotonic", "closed-loop-inverse"):
        assert name in listed
    assert "[devices.tec]" in done([bench, "show", "vo2"], tmp_path, variables)
    done([bench, "new", "device", "micro-balance"], tmp_path, variables)
    assert (tmp_path / "micro-balance" / "pyproject.toml").is_file()
