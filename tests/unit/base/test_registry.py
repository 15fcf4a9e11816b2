"""What is registered by packages, and what hides the bench's own."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from cases import cases

from bench.base import ConfigurationError, registry
from bench.cli import main
from bench.rig import load_rig, packaged_rigs

PROTOCOL = '''
from bench.protocol import Dwell
from bench.protocol import ProtocolParameters, Step, parameter, protocol

class Parameters(ProtocolParameters):
    count: int = parameter(1, unit="1", help="how often")

@protocol(needs=("tec",))
def {name}(parameters: Parameters):
    """Wait."""
    yield Step({{}}, Dwell(1.0))
'''


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Put a package's metadata and files on the import path, as pip would; undo it at the end."""
    modules = set(sys.modules)

    def install(name, entry_points, files=None):
        site = tmp_path / f"site-{name}"
        info = site / f"{name.replace('-', '_')}-1.0.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        groups = [f"[bench.{group}]\n{line}\n" for group, lines in entry_points.items() for line in lines]
        (info / "entry_points.txt").write_text("".join(groups))
        for file, text in (files or {}).items():
            path = site / file
            path.parent.mkdir(exist_ok=True)
            path.write_text(text)
        monkeypatch.syspath_prepend(str(site))
        registry.forget()
        return site

    yield install
    for name in set(sys.modules) - modules:
        if name.startswith("outside_"):
            del sys.modules[name]
    monkeypatch.undo()
    registry.forget()


@pytest.fixture
def list_(capsys):
    """Run `bench list`; return exit code, output and errors."""

    def run(*arguments):
        with pytest.raises(SystemExit) as stopped:
            main(["list", *arguments])
        return stopped.value.code or 0, *capsys.readouterr()

    return run


class TestEntries:
    def test_own_and_foreign(self, install):
        install(
            "outside-coil", {"protocols": ["wait = outside_wait"]}, {"outside_wait.py": PROTOCOL.format(name="nap")}
        )
        entries = registry.entries("protocols")
        assert list(entries) == sorted(entries)
        assert (entries["protocols"].own, entries["protocols"].package) == (True, registry.OWN_PACKAGE)
        assert (entries["wait"].own, entries["wait"].package) == (False, "outside-coil")
        assert entries["wait"].load().__name__ == "outside_wait"

    @cases("group", registry.GROUPS)
    def test_each_of_our_own_can_be_imported(self, group):
        """`bench list` imports none of the groups that it does not show."""
        for entry in registry.entries(group).values():
            if entry.own:
                assert entry.load() is not None

    def test_an_unknown_group(self):
        with pytest.raises(ValueError, match="group: expected one of rigs, protocols"):
            registry.entries("colours")

    @cases(("group", "what"), [("models", "model"), ("studies", "study"), ("laboratories", "laboratory")])
    def test_an_unknown_name_says_where_all_are(self, group, what):
        with pytest.raises(ConfigurationError, match=f"there is no {what} 'magic'; (there are: |`bench list` shows)"):
            registry.load(group, "magic")

    def test_two_packages_with_one_name(self, install, list_):
        install("outside-one", {"models": ["same = outside_one:MODEL"]})
        install("outside-two", {"models": ["same = outside_two:MODEL"]})
        with pytest.raises(ConfigurationError, match=r"packages outside-\w+ and outside-\w+ both register 'same' in"):
            registry.entries("models")
        code, _, errors = list_()
        assert code == 2
        assert "both register 'same' in bench.models; uninstall one" in errors

    def test_two_packages_with_one_rig(self, install):
        files = {"outside_rigs/__init__.py": "", "outside_rigs/vo2.toml": "[rig]\ntitle = 'mine'\n"}
        install("outside-rigs", {"rigs": ["mine = outside_rigs"]}, files)
        with pytest.raises(ConfigurationError, match=r"both bring a rig 'vo2'; uninstall one"):
            packaged_rigs()


class TestBroken:
    """An entry that cannot be imported is named and skipped; it is an error only for those who ask for it."""

    @pytest.mark.parametrize("group", registry.GROUPS)
    def test_is_named_and_skipped(self, install, list_, group):
        install("outside-broken", {group: ["broken = outside_gone:THING"]})
        code, out, errors = list_()
        assert code == 0
        assert "damped-oscillation" in out
        assert "vo2" in out
        assert errors.count("left out: package outside-broken: entry point broken = 'outside_gone:THING' of") == 1
        assert "ModuleNotFoundError: No module named 'outside_gone'; mend the package or uninstall it" in errors
        with pytest.raises(
            ConfigurationError, match=f"outside-broken: entry point broken .* of bench.{group} cannot be"
        ):
            registry.load(group, "broken")

    @pytest.mark.parametrize("code", ["1 / 0", "def broken(:", "raise RuntimeError('no')"])
    def test_a_module_that_fails_in_any_way(self, install, list_, code):
        install("outside-fails", {"protocols": ["fails = outside_fails"]}, {"outside_fails.py": code})
        exit_code, out, errors = list_()
        assert exit_code == 0
        assert "creep" in out
        assert "package outside-fails: entry point fails" in errors

    def test_a_rig_that_is_asked_for_by_name(self, install):
        install("outside-broken", {"rigs": ["broken = outside_gone"]})
        with pytest.raises(ConfigurationError, match=r"there is no rig 'coil'; (.|\n)*outside-broken"):
            load_rig("coil")

    def test_the_package_of_what_is_not_our_own_is_shown(self, install, list_):
        install(
            "outside-coil", {"protocols": ["wait = outside_nap"]}, {"outside_nap.py": PROTOCOL.format(name="nap")}
        )
        code, out, errors = list_()
        assert (code, errors) == (0, "")
        assert "[outside-coil]" in " ".join(out.split())


def run_list(command, folder, **environment):
    return subprocess.run(
        [*command, "list"], cwd=folder, capture_output=True, text=True, check=False, env=os.environ | environment
    )


class TestHidden:
    """A foreign folder or module of the name of one of ours is an error that says so."""

    @cases("place", ["protocols/__init__.py", "protocols/notes.txt", "protocols.py", "drivers/x.py"])
    def test_in_the_working_directory(self, tmp_path, place):
        (tmp_path / place).parent.mkdir(exist_ok=True)
        (tmp_path / place).write_text("")
        done = run_list([sys.executable, "-m", "bench"], tmp_path)
        assert done.returncode == 2
        assert done.stdout == ""
        name = place.split("/")[0].removesuffix(".py")
        hiding = tmp_path / (place if "/" not in place else name)
        assert f"error: {hiding} hides the bench's own package {name!r}" in done.stderr
        assert "run the bench from another folder" in done.stderr

    def test_the_installed_command_does_not_look_there(self, tmp_path):
        (tmp_path / "protocols").mkdir()
        command = [str(Path(sys.executable).parent / "bench")]
        done = run_list(command, tmp_path)
        assert (done.returncode, done.stderr) == (0, "")
        assert "damped-oscillation" in done.stdout
        # Unless it is made to.
        done = run_list(command, tmp_path, PYTHONPATH=str(tmp_path))
        assert done.returncode == 2
        assert "hides the bench's own package 'protocols'" in done.stderr
