"""`bench new` writes packages whose tests pass, and refuses what could not work."""

import os
import sys

import pytest

from bench.cli import main
from bench.cli.skeletons import PARTS


def new(*arguments):
    with pytest.raises(SystemExit) as ended:
        main(["new", *arguments])
    return ended.value.code


@pytest.mark.parametrize(
    "parts", [pytest.param(["model"], id="a model"), pytest.param(list(PARTS), id="all", marks=pytest.mark.seeds)]
)
def test_the_tests_of_skeletons_pass(tmp_path, monkeypatch, capsys, warm_process, parts):
    monkeypatch.chdir(tmp_path)
    for part in parts:
        assert new(part, f"my-own-{part}") == 0
        assert f"python -m pytest my-own-{part}" in capsys.readouterr().out
        assert "$" not in (tmp_path / f"my-own-{part}" / "pyproject.toml").read_text()
    site = tmp_path / "site"
    environment = {
        **os.environ,
        "PYTHONPATH": str(site),
        "PIP_TARGET": str(site),
        "PIP_NO_INDEX": "1",
        "PIP_NO_DEPS": "1",
        # This is how pip spells --no-build-isolation in its environment.
        "PIP_NO_BUILD_ISOLATION": "0",
    }
    folders = [f"./my-own-{part}" for part in parts]
    installed = warm_process([sys.executable, "-m", "pip", "install", "-q", *folders], tmp_path, environment)
    assert installed.returncode == 0, installed.stderr
    tested = warm_process(
        [sys.executable, "-m", "pytest", "-q", "-W", "error", "-p", "no:cacheprovider", *folders],
        tmp_path,
        environment,
    )
    assert tested.returncode == 0, tested.stdout
    assert " passed" in tested.stdout
    listed = warm_process([sys.executable, "-m", "bench", "list"], tmp_path, environment)
    assert all(f"my-own-{part}" in listed.stdout for part in {*parts} & {"protocol", "model", "rig"})


@pytest.mark.parametrize(
    ("part", "name", "expected"),
    [
        ("device", "Balance", "lower-case letters"),
        ("model", "my_model", "lower-case letters"),
        ("protocol", "class", "lower-case letters"),
        ("model", "preisach", "of the package actuator-bench"),
    ],
)
def test_a_name_that_could_not_work_is_refused(tmp_path, monkeypatch, capsys, part, name, expected):
    monkeypatch.chdir(tmp_path)
    assert new(part, name) == 2
    assert expected in " ".join(capsys.readouterr().err.split())
    assert not list(tmp_path.iterdir())


def test_what_exists_is_left_alone(tmp_path, capsys):
    (tmp_path / "mine").mkdir()
    assert new("rig", "mine", "--out", str(tmp_path)) == 2
    assert "exists already" in " ".join(capsys.readouterr().err.split())
    assert not list((tmp_path / "mine").iterdir())
