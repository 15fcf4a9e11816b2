"""The README and the pages for contributors: code runs, commands and options exist, links lead somewhere."""

import ast
import importlib
import re
import shlex
from pathlib import Path

import pytest
from cases import cases
from typer.main import get_command

import bench
from bench.cli import app

ROOT = Path(__file__).parents[3]
README = (ROOT / "README.md").read_text()
PAGES = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md")] + sorted(
    (ROOT / "docs").rglob("*.md")
)


def blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```$", README, re.DOTALL | re.MULTILINE)


def commands():
    """Yield each command line of the README, from blocks and from the text, and those of tutorials and guides."""
    others = [
        line.strip()
        for folder in ("tutorials", "how-to")
        for page in sorted((ROOT / "docs" / folder).glob("*.md"))
        for block in re.findall(r"^ *```(?:ba)?sh\n(.*?)^ *```$", page.read_text(), re.DOTALL | re.MULTILINE)
        for line in block.replace("\\\n", " ").splitlines()
    ]
    shell = "\n".join([*blocks("sh"), *others]).replace("\\\n", " ")
    text = re.sub(r"^```.*?^```$", "", README, flags=re.DOTALL | re.MULTILINE)
    for line in [*shell.splitlines(), *(code.replace("\n", " ") for code in re.findall(r"`([^`]+)`", text))]:
        if line.split(maxsplit=1)[:1] in (["bench"], ["make"]):
            yield re.split(r"[#>|&]", line)[0].strip()


def test_the_readme_has_commands():
    found = list(commands())
    assert len(found) > 25
    assert {line.split()[0] for line in found} == {"bench", "make"}


@cases("line", sorted({line for line in commands() if line.startswith("bench ")}))
def test_every_command_and_option_exists(line):
    command, arguments = get_command(app), shlex.split(line)[1:]
    context = None
    while arguments and hasattr(command, "get_command") and not arguments[0].startswith("-"):
        context = command.make_context(arguments[0], [], resilient_parsing=True)
        group, name = command, arguments.pop(0)
        # Words that are no command are those of the command that a group names for them, as a file of `bench study`.
        command = group.get_command(context, name) or group.get_command(context, group.otherwise)
        assert command is not None, f"there is no command {name}"
    known = {"--help", *(option for each in command.params for option in (*each.opts, *each.secondary_opts))}
    assert {argument for argument in arguments if argument.startswith("--")} <= known


@cases("target", sorted({line.split()[1] for line in commands() if line.startswith("make ")}))
def test_every_target_of_make_exists(target):
    assert re.search(rf"^\.PHONY:.* {target}( |$)", (ROOT / "Makefile").read_text(), re.MULTILINE)


@cases("page", PAGES)
def test_python_takes_from_the_bench_what_it_has(page):
    for block in re.findall(r"^```python[^\n]*\n(.*?)^```$", page.read_text(), re.DOTALL | re.MULTILINE):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and node.module.split(".")[0] in ("bench", "drivers", "sim_devices"):
                module = importlib.import_module(node.module)
                missing = [each.name for each in node.names if not hasattr(module, each.name)]
                assert not missing, f"{node.module} has no {missing}"
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "bench":
                assert hasattr(bench, node.attr), f"bench has no {node.attr}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_leads_to_a_file(page):
    # An equation may have a bracket before a parenthesis.
    text = re.sub(r"\$\$.*?\$\$", "", page.read_text(), flags=re.DOTALL)
    for link in re.findall(r"\]\(([^)#]+)", text):
        # The site writes its generated pages when it is built, and fails on a link to none.
        if not link.startswith("http") and "generated/" not in link:
            assert (page.parent / link).exists(), link


def test_the_script_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (script,) = (block for block in blocks("python") if block.startswith("import bench"))
    names = {}
    exec(compile(script, "README.md", "exec"), names)
    assert len(names["setpoints"]) == 2
