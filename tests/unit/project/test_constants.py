"""Each number that decides something says where it comes from."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
PACKAGES = ["bench/control", "bench/dashboard", "bench/identification", "bench/models", "bench/specimen"]
WORDS = ("Source:", "Derivation:")


def is_number(value):
    """Return whether an expression is written with numbers, not as a call that makes something of them."""
    numbers = (each.value for each in ast.walk(value) if isinstance(each, ast.Constant))
    return not isinstance(value, ast.Call) and any(type(each) in (int, float) for each in numbers)


def constants(tree):
    """Yield the place in the body and the names of each constant of a module."""
    for place, node in enumerate(tree.body):
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None and is_number(node.value):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = [each.id for target in targets for each in ast.walk(target) if isinstance(each, ast.Name)]
            if any(name.isupper() for name in names):
                yield place, names


def said(tree, lines, place):
    """Return the docstring below a constant, or the comment above it or above neighbours without a blank line."""
    body = tree.body
    for last, node in zip(body[place:], body[place + 1 :], strict=False):
        if node.lineno > last.end_lineno + 1:
            break
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            return str(node.value.value)
    first = body[place].lineno - 1
    while first and lines[first - 1].strip():
        first -= 1
    return "\n".join(line for line in lines[first : body[place].lineno - 1] if line.startswith("#"))


def unsaid(text):
    """Return the names of the constants of a module whose source is not said."""
    tree, lines = ast.parse(text), text.splitlines()
    found = [(names, said(tree, lines, place)) for place, names in constants(tree)]
    return [name for names, words in found if not any(word in words for word in WORDS) for name in names]


@pytest.mark.parametrize("package", PACKAGES)
def test_each_number_says_its_source(package):
    files = sorted((ROOT / package).rglob("*.py"))
    assert files
    assert {file.name: names for file in files if (names := unsaid(file.read_text(encoding="utf-8")))} == {}


def test_a_number_without_a_source_is_found():
    assert unsaid('A = 1.0\n"""Length, m. Source: a ruler."""\nB, _C = 2, (3,)\n"""Two."""\n') == ["B", "_C"]
    assert unsaid("# Derivation: counted.\nA = 1\nB: int = -2\n\nC = 3\nNAMES = range(3)\n") == ["C"]
