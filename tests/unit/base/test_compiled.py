"""Compiled functions with and without a way in from Python."""

import os
import sys

import pytest
from cases import cases

from bench.base import inlined, inner, kernel, reordered


@inner
def doubled(x):
    return 2.0 * x


@inlined
def increased(x):
    return x + 1.0


@kernel
def both(x):
    return doubled(increased(x))


@reordered
def total(numbers):
    result = 0.0
    for number in numbers:
        result += doubled(number)
    return result


def test_python_calls_kernels_and_these_the_others():
    assert both(2.0) == 6.0
    assert total((1.0, 2.0, 3.0)) == 12.0


@cases("function", [doubled, increased])
def test_the_others_refuse_a_call_from_python(function):
    both(2.0)
    with pytest.raises(TypeError, match=f"{function.py_func.__name__} is called by compiled functions only"):
        function(2.0)


SCALE = "FACTOR = {factor}\n"
STEPS = "from bench.base import inner\nfrom loops.scale import FACTOR\n\n\n@inner\ndef step(x):\n    return {step}\n"
USES = "from bench.base.compiled import kernel\nfrom loops import _steps_kernels as steps\n\nstep = steps.step\n\n\n"
USES += "@kernel\ndef use(x):\n    return step(x)\n"
# A warm process has loaded numba, with another cache.
PROGRAM = "import sys\nfrom numba.core import config\nsys.dont_write_bytecode = True\nconfig.reload_config()\n"
PROGRAM += "from loops._uses_kernels import use\nprint(use(3.0), *use.stats.cache_hits.values())\n"


def test_a_change_of_another_file_that_is_compiled_in_counts(tmp_path, warm_process):
    loops = tmp_path / "loops"
    loops.mkdir()
    (loops / "__init__.py").touch()
    (loops / "_uses_kernels.py").write_text(USES)

    def used(number, factor, step):
        for name, text in (("scale", SCALE.format(factor=factor)), ("_steps_kernels", STEPS.format(step=step))):
            path = loops / f"{name}.py"
            if not path.exists() or path.read_text() != text:
                path.write_text(text)
                # Whatever the resolution of the file system's times, and of Python's own files.
                os.utime(path, (1e9 + 10 * number, 1e9 + 10 * number))
        place = {"PYTHONPATH": str(tmp_path), "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
        done = warm_process([sys.executable, "-c", PROGRAM], tmp_path, os.environ | place)
        assert done.returncode == 0, done.stderr
        return done.stdout.split()

    assert used(0, 2.0, "FACTOR * x") == ["6.0"]
    # Unchanged, it comes from the disk.
    assert used(1, 2.0, "FACTOR * x") == ["6.0", "1"]
    assert used(2, 2.0, "FACTOR + x") == ["5.0"]
    assert used(3, 4.0, "FACTOR + x") == ["7.0"]
