"""What every device of the bench promises of the keys that a rig file gives it."""

import math

from cases import cases
from pydantic import ValidationError

from bench.base.registry import entries, load
from bench.devices import DriverSettings

DRIVERS = sorted(name for name, entry in entries("devices").items() if entry.own)


def tables(settings):
    """Yield the settings and those of the tables within."""
    yield settings
    for field in settings.model_fields.values():
        if hasattr(field.annotation, "model_fields"):
            yield from tables(field.annotation)


def is_refused(settings, key, value):
    """Whether a value is refused because of its key, whatever the other keys are."""
    try:
        settings(**{key: value})
    except ValidationError as error:
        return any(one["loc"][:1] == (key,) for one in error.errors())
    return False


@cases("driver", DRIVERS)
def test_each_key_is_described_and_takes_its_default_and_no_number_that_is_none(driver):
    for settings in tables(load("devices", driver).Settings):
        assert is_refused(settings, "no_such_key", 1)
        for key, field in settings.model_fields.items():
            assert field.description or key in DriverSettings.model_fields, key
            if field.annotation in (float, int):
                assert is_refused(settings, key, math.nan), key
                assert is_refused(settings, key, math.inf), key
            if not field.is_required():
                assert not is_refused(settings, key, field.get_default(call_default_factory=True)), key
