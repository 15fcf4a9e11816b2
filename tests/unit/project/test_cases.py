"""A table of cases in one test."""

import pytest
from cases import cases


def halve(fixture, value, half):
    fixture.append(value)
    assert value / 2 == half


def test_every_case_is_tried_and_each_failure_names_its_case():
    tried = []
    with pytest.raises(BaseExceptionGroup, match="1 of 3 cases") as raised:
        cases(("value", "half"), [(2, 1), (4, 3), (6, 3)])(halve)(fixture=tried)
    assert tried == [2, 4, 6]
    (failure,) = raised.value.exceptions
    assert failure.__notes__ == ["in the case 4, 3"]
    cases("value", [2, 4])(lambda fixture, value: fixture.append(value))(fixture=tried)
    assert tried[3:] == [2, 4]


def test_an_exception_that_is_not_raised_is_a_failure():
    def wants_an_error(value):
        with pytest.raises(ValueError, match="x"):
            int(value)

    with pytest.raises(BaseExceptionGroup, match="2 of 2 cases"):
        cases("value", ["1", "2"])(wants_an_error)()


@cases("number", [1, 2])
def test_fixtures_are_those_of_pytest(tmp_path, number):
    assert tmp_path.is_dir()
    assert number in (1, 2)
