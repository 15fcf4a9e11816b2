"""The tutorials, the how-to guides, and the pages of `docs/reference` with examples, executed.

A reader who copies their blocks in order gets what the page says.

A block with `file: NAME` after its language is written to that file, `sh` and `python` without it are run, and each
line of a `text` block has to occur in what the block before it has printed; in a `text like` block any number stands
for any other, and so does any blank. A `bash` block is for hardware, or takes long: it is not run, but its commands
and options have to exist. A `c` block is not run either.
"""

import os
import re
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[3] / "docs"
PAGES = [
    path
    for folder in ("tutorials", "how-to")
    for path in sorted((DOCS / folder).glob("*.md"))
    # The notebook is executed as one, see `test_notebook.py`.
    if path.stem not in {"index", "use-a-notebook"}
]
EXECUTED = [*PAGES, *(DOCS / "reference" / f"{name}.md" for name in ("campaign", "interlocks"))]
LONG = {
    "add-a-controller",
    "campaign",
    "deploy",
    "describe-an-instrument",
    "first-day",
    "hybrid",
    "identify-from-a-file",
    "resume-a-run",
    "sma",
    "use-an-fmu",
    "vo2",
}
"""Some seconds each; of these `make test` looks at the commands only (`test_readme.py`)."""
BLOCK = re.compile(r"^```(\w+(?: like)?)(?: file: (\S+))?\n(.*?)^```$", re.MULTILINE | re.DOTALL)
NUMBER = re.compile(r"[-+]?\d[\d.,:]*(?:e[-+]?\d+)?")


def pattern(line):
    """Return what a line of a `text like` block stands for."""
    words = (map(re.escape, NUMBER.split(word)) for word in line.split())
    return r"\s+".join(NUMBER.pattern.join(word) for word in words)


@pytest.fixture
def environment(tmp_path, warm_commands):
    """What a reader has: the bench and pip, which here installs into a folder of its own, offline."""
    site = tmp_path / "site"
    return {
        **os.environ,
        "PATH": os.pathsep.join([str(warm_commands), str(Path(sys.executable).parent), os.environ["PATH"]]),
        "PYTHONPATH": str(site),
        "PIP_TARGET": str(site),
        "PIP_NO_INDEX": "1",
        "PIP_NO_DEPS": "1",
        # This is how pip spells --no-build-isolation in its environment.
        "PIP_NO_BUILD_ISOLATION": "0",
        "COLUMNS": "200",
    }


@pytest.mark.parametrize(
    "path",
    [pytest.param(path, id=path.stem, marks=[pytest.mark.seeds] if path.stem in LONG else []) for path in EXECUTED],
)
def test_page(path, tmp_path, environment, finished_process, warm_process, request):
    page, printed = path.stem, None
    if path.parent.name == "tutorials":
        environment = {**environment, "COLUMNS": "80"}
    if "gcc" in path.read_text() or "--fmu" in path.read_text():
        request.getfixturevalue("gcc")
    for language, name, text in BLOCK.findall(path.read_text()):
        if name:
            (tmp_path / name).write_text(text)
        elif language.startswith("text"):
            assert printed is not None, f"{page}: a text block stands after no block that prints"
            for line in filter(None, map(str.strip, text.splitlines())):
                wanted = pattern(line) if language.endswith("like") else re.escape(line)
                assert re.search(wanted, printed), f"{page}: {line!r} is not in\n{printed}"
        elif language not in ("bash", "c"):
            command, run = {
                "sh": (["sh", "-e", "-c"], finished_process),
                "python": ([sys.executable, "-c"], warm_process),
            }[language]
            chosen = environment
            if "$!" in text:
                # Who is to be killed has to be the process that was started.
                chosen = {**environment, "PATH": environment["PATH"].partition(os.pathsep)[2]}
            done = run([*command, text], tmp_path, chosen)
            printed = done.stdout
            assert done.returncode == 0, f"{page}: {text}\n{printed}{done.stderr}"


def test_there_are_the_pages_for_what_others_add():
    pages = {path.stem: BLOCK.findall(path.read_text()) for path in PAGES}
    parts = ("device", "rig", "model", "protocol", "controller")
    assert pages.keys() >= {f"add-a-{part}" for part in parts} | {"vo2", "sma", "hybrid"}
    for page, blocks in pages.items():
        assert any(not name and language in ("sh", "python") for language, name, _ in blocks), page
