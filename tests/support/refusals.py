"""Which key of a device is to blame for settings that are refused."""

import pytest
from pydantic import ValidationError


def blamed(settings, keys):
    """Return the keys that are named by the error for wrong settings."""
    with pytest.raises(ValidationError) as raised:
        settings(**keys)
    return {
        str(error["loc"][0]) if error["loc"] else error["msg"].removeprefix("Value error, ").partition(":")[0]
        for error in raised.value.errors()
    }
