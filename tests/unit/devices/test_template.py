"""Templates: what is read from a message is the number that stands there, or nothing."""

import math
import re

import pytest
from cases import cases
from hypothesis import assume, given, strategies as st

from bench.devices import Template, template

finite = st.floats(-1e30, 1e30)


@cases(
    ("form", "message", "numbers"),
    [
        ("{value}", " +1.50E+00 ", {"value": 1.5}),
        ("{value}NDCV,{any}", "-1.5NDCV,+0.0SECS", {"value": -1.5}),
        ("{a},{b},{any}", "1,2,x", {"a": 1.0, "b": 2.0}),
        ("{value} {any}", "2.5 3.5", {"value": 2.5}),
        ("{value}{any}", "500.0 mV", None),
        ("{value}{any}", "1E5.5", None),
        ("{any},{value}", "X2,5", None),
        ("{any}{value}", "- 5", None),
        ("{any}E{value}", "2E5", None),
        ("{any}{value}", "VDC 12.25", {"value": 12.25}),
        ("VOLT {value:.3f} V", "volt   5.00  v", {"value": 5.0}),
        ("{a};{b}", "1 ; 2", {"a": 1.0, "b": 2.0}),
        ("{value}", "OL", None),
        ("{value}", "1,2", None),
        ("{value}", "1e999", None),
        ("{value}", "-9.9E+37", None),
        ("{value}", "9.91E37", None),
        ("{value}", "nan", None),
        ("EXAMPLE,{any}", "EXAMPLE,PS,1,2", {}),
        ("EXAMPLE,{any}", "OTHER,PS,1,2", None),
    ],
)
def test_a_reply_is_read_as_its_form_says(form, message, numbers):
    assert Template(form).match(message) == numbers


@given(value=finite, before=st.text("ABC ,;:", max_size=5), after=st.text("V ,;", max_size=5))
def test_what_was_written_is_read_back(value, before, after):
    form = Template(f"{before}{{value:.10e}}{after}")
    (found,) = form.match(form.fill({"value": value})).values()
    assert math.isclose(found, value, rel_tol=1e-9, abs_tol=1e-300)


FORMS = ["{value}", "{value}{any}", "{any}{value}", "A {a},{b}", "{any},{value} {any}"]


@given(message=st.text(max_size=200), form=st.sampled_from(FORMS))
def test_any_answer_is_a_number_or_none(message, form):
    numbers = Template(form).match(message)
    assert numbers is None or all(math.isfinite(number) for number in numbers.values())
    if numbers is None and form == "{value}":
        text = message.strip()
        assert not re.fullmatch(r"[-+]?[0-9]{1,9}(\.[0-9]{1,9})?([eE][-+]?[0-9])?", text)


BESIDE = st.text("0123456789.,;:eE+- \tmVuA%°x", max_size=6)
"""Text beside a number, as treacherous as any."""


@st.composite
def written_numbers(draw, sign):
    """Return a number and how an instrument writes it, with a decimal sign."""
    digits = draw(st.from_regex(r"[-+]?[0-9]{1,4}(\.[0-9]{1,4})?([eE][-+]?[0-9])?", fullmatch=True))
    return float(digits), digits.replace(".", sign)


def number_in(sign):
    """Return the form of a number with this decimal sign, which may stand behind its own sign and a space."""
    return rf"(?:[-+]\s*)?(?:[0-9]+[{sign}]?[0-9]*|[{sign}][0-9]+)(?:[eE][-+]?[0-9]+)?"


@pytest.mark.parametrize("form", ["{value}{any}", "{value},{any}", "{value} {any}"])
@given(data=st.data(), sign=st.sampled_from(".,"), told=st.booleans(), after=BESIDE)
def test_any_text_never_takes_a_part_of_the_number_before_it(form, data, sign, told, after):
    number, text = data.draw(written_numbers(sign))
    whole = re.match(number_in(sign), text + after)[0]
    assume(whole.rstrip(sign) == text)
    # A point that is not told to be something else is a decimal sign.
    assume(len(re.match(number_in("."), text + after)[0].rstrip(".")) <= len(text))
    assert template(form, sign if told else None).match(text + after) in (None, {"value": number})
    if not after[:1].isdigit():
        assert template("{value},{any}", sign).match(f"{text},{after}") == {"value": number}


@pytest.mark.parametrize("form", ["{any}{value}", "{any},{value}", "{any};{value}", "{any} {value}"])
@given(data=st.data(), sign=st.sampled_from(".,"), told=st.booleans(), before=BESIDE)
def test_any_text_never_takes_a_part_of_the_number_behind_it(form, data, sign, told, before):
    number, text = data.draw(written_numbers(sign))
    assume(re.search(rf"{number_in(sign)}\Z", before + text)[0] == text)
    assume(len(re.search(rf"{number_in('.')}\Z", before + text)[0]) <= len(text))
    assert template(form, sign if told else None).match(before + text) in (None, {"value": number})
    assert template("{any};{value}", sign).match(f"{before}x;{text}") == {"value": number}


PREFIXES = {"p": 1e-12, "n": 1e-9, "u": 1e-6, "µ": 1e-6, "m": 1e-3, "": 1.0, "k": 1e3, "G": 1e9}


@given(
    number=st.decimals(-999, 999, places=3),
    prefix=st.sampled_from([*PREFIXES]),
    unit=st.sampled_from("VAWN"),
    wanted=st.sampled_from("VAWN"),
    space=st.sampled_from(["", " "]),
    after=st.sampled_from(["", ";x", " 3", ",+1"]),
)
def test_a_unit_is_converted_or_refused_and_never_passed_over(number, prefix, unit, wanted, space, after):
    message = f"{number}{space}{prefix}{unit}{after}"
    form = "{value}{unit}{any}" if after else "{value}{unit}"
    found = template(form).match(message, {"value": wanted})
    if unit == wanted:
        assert found == {"value": pytest.approx(float(number) * PREFIXES[prefix], rel=1e-12)}
    else:
        assert found is None
    assert template("{value}{any}").match(message) is None


@cases(
    ("sent", "wanted", "value"),
    [
        ("22.5 C", "°C", 22.5),
        ("22.5 °C", "°C", 22.5),
        ("300.15K", "°C", 27.0),
        ("22.5C", "K", 295.65),
        ("1.5kΩ", "ohm", 1500.0),
        ("25 %", "1", 0.25),
        ("12.5 um", "m", 12.5e-6),
        ("5MV", "V", None),
        ("5PA", "A", None),
        ("5EV", "V", None),
        ("5VDC", "V", None),
        ("5mA", "V", None),
        ("5mV2", "V", None),
        ("5", "V", None),
    ],
)
def test_units_as_instruments_send_them(sent, wanted, value):
    found = template("{value}{unit}").match(sent, {"value": wanted})
    assert found == (None if value is None else {"value": pytest.approx(value)})


@cases(
    ("form", "message", "advice"),
    [
        ("{value},{any}", "2,215E+01", "decimal"),
        ("{value}{any}", "500.0 mV", "{unit}"),
        ("{value}{unit}", "5 MV", "mV"),
        ("{value}{unit}", "5 A", "'A'"),
        ("{value}", "1,5", "decimal"),
        ("{value}", "1.234,5", "thousands"),
        ("{value} {unit}", "12 345.5 mV", "thousands"),
        ("{value}", "OL", ""),
    ],
)
def test_a_number_that_is_not_clear_says_what_to_do(form, message, advice):
    assert advice in template(form).doubt(message, {"value": "V"})
    assert advice or not template(form).doubt(message, {"value": "V"})


@given(value=st.floats(-1e6, 1e6), sign=st.sampled_from([None, ".", ","]))
def test_with_units_and_either_sign_what_was_written_is_read_back(value, sign):
    form = template("{value:.9e} {unit};{any}", sign)
    found = form.match(form.fill({"value": value}, "5,5", {"value": "V"}), {"value": "V"})
    assert found == {"value": pytest.approx(value, rel=1e-8, abs=1e-17)}


def test_any_text_never_takes_a_part_of_a_unit():
    assert template("{value}{unit}{any}").match("5 m/s;x", {"value": "m/s"}) == {"value": 5.0}
    for rest in ("2", "^2", "*s"):
        assert template("{value}{unit}{any}").match(f"5 m/s{rest}", {"value": "m/s"}) is None
