"""Compiled functions with and without a way in from Python."""

import pytest

from bench.compiled import inlined, inner, kernel, reordered


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


@pytest.mark.parametrize("function", [doubled, increased])
def test_the_others_refuse_a_call_from_python(function):
    both(2.0)
    with pytest.raises(TypeError, match=f"{function.py_func.__name__} is called by compiled functions only"):
        function(2.0)
