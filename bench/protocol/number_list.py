"""Lists of numbers as parameters: a tuple in Python, `0.98, 2.94` on the command line."""

from __future__ import annotations

import math
from typing import Annotated, Any, TypeAlias

from pydantic import BeforeValidator


def _parse(value: Any) -> Any:  # noqa: ANN401 - the setting of a parameter, of any type
    if not isinstance(value, str):
        return value
    numbers = []
    for part in value.split(","):
        try:
            number = float(part)
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            raise ValueError(f"{part.strip()!r} is not a finite number")
        numbers.append(number)
    return tuple(numbers)


NumberList: TypeAlias = Annotated[tuple[float, ...], BeforeValidator(_parse)]
"""Type of a protocol's parameter: finite numbers, as a sequence or as a text with commas between them."""
