"""A table of cases as one test: hundreds of small tests take most of their time to be set up and reported."""

import functools
import inspect

import pytest


def cases(names, rows):
    """Call a test with each row of a table, in place of `pytest.mark.parametrize`; every row that fails is named.

    A test that takes `tmp_path` gets a folder of its own for each row. Other fixtures are shared by the rows.
    """
    names = [name.strip() for name in names.split(",")] if isinstance(names, str) else list(names)
    table = [(row,) if len(names) == 1 else tuple(row) for row in rows]
    assert table, "no cases"

    def decorate(test):
        @functools.wraps(test)
        def every(*bound, **fixtures):
            failures = []
            folder = fixtures.get("tmp_path")
            for number, row in enumerate(table):
                if folder is not None:
                    fixtures["tmp_path"] = folder / f"case-{number}"
                    fixtures["tmp_path"].mkdir()
                try:
                    test(*bound, **fixtures, **dict(zip(names, row, strict=True)))
                # Of `pytest.raises`, if nothing was raised.
                except (Exception, pytest.fail.Exception) as error:
                    error.add_note(f"in the case {', '.join(map(repr, row))}")
                    failures.append(error)
            if failures:
                raise BaseExceptionGroup(f"{len(failures)} of {len(table)} cases", failures)

        signature = inspect.signature(test)
        fixtures = [parameter for name, parameter in signature.parameters.items() if name not in names]
        every.__signature__ = signature.replace(parameters=fixtures)
        return every

    return decorate
