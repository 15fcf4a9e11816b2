"""All outputs of a plant at one instant."""

from collections import namedtuple


def snapshot(plant):
    """Every property of the plant that is a number, as a named tuple."""
    names = [name for name in dir(type(plant)) if isinstance(getattr(type(plant), name), property)]
    values = {name: getattr(plant, name) for name in names if not name.startswith("_")}
    numbers = {name: value for name, value in values.items() if isinstance(value, float | int)}
    return namedtuple("Snapshot", numbers)(**numbers)
