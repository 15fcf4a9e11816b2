"""A table of cases in one test, for bodies that are much quicker than what pytest does around a test."""

import functools
import inspect

import pytest


def each_case(names, cases):
    """Call a test with each case of a table, and report all cases that fail.

    It takes the place of `pytest.mark.parametrize` where the cases need no fixture of their own: fixtures are made
    once for all of them.

    Parameters
    ----------
    names : str or tuple of str
        Arguments that are taken from the table.
    cases : iterable
        Values of the arguments, in a tuple if there are several.
    """
    single = isinstance(names, str)
    names, cases = ((names,), [(case,) for case in cases]) if single else (tuple(names), list(cases))

    def decorate(test):
        signature = inspect.signature(test)

        @functools.wraps(test)
        def run(*own, **fixtures):
            failures = []
            for number, case in enumerate(cases):
                arguments = dict(zip(names, case, strict=True))
                try:
                    test(*own, **fixtures, **arguments)
                except (Exception, pytest.fail.Exception) as failure:
                    failure.add_note(f"case {number}: {arguments!r:.500}")
                    failures.append(failure)
            if failures:
                raise BaseExceptionGroup(f"{len(failures)} of {len(cases)} cases failed", failures)

        del run.__wrapped__
        kept = [parameter for name, parameter in signature.parameters.items() if name not in names]
        run.__signature__ = signature.replace(parameters=kept)
        return run

    assert cases
    return decorate
