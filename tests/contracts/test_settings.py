"""What a rig file may say of each device: keys, defaults, bounds and units, against the table beside this file.

A default that changes would change a stranger's rig without a word, and a bound would let pass what its instrument
does not take. `settings.txt` has one line a key: name, default (none if it has to be given), allowed values, unit.
Its numbers are those of the makers' manuals where they have any (see the sources of each driver). A key of a table
within the table of the device has the name of that table in front.
"""

import json
import re
from pathlib import Path

import pytest

from bench.devices import DriverSettings
from bench.registry import entries, load

TABLE = Path(__file__).with_name("settings.txt")
SHARED = set(DriverSettings.model_fields)


def allowed(schema, definitions):
    """Return the allowed values of a key in a few words; empty if its type alone says it."""
    if "$ref" in schema:
        schema = definitions[schema["$ref"].rpartition("/")[2]]
    words = []
    if choices := schema.get("enum", [schema["const"]] if "const" in schema else []):
        words.append(" | ".join(map(str, choices)))
    low, above = schema.get("minimum"), schema.get("exclusiveMinimum")
    high, below = schema.get("maximum"), schema.get("exclusiveMaximum")
    if {low, above, high, below} != {None}:
        begin = f"({shown(above)}" if low is None else f"[{shown(low)}"
        end = f"{shown(below)})" if high is None else f"{shown(high)}]"
        words.append(f"{begin}, {end}")
    if "maxItems" in schema:
        words.append(f"{schema['maxItems']} of them")
    else:
        words += [
            f"{schema[key]} or more of them" for key in ("minLength", "minItems", "minProperties") if key in schema
        ]
    words += [schema[key] for key in ("pattern",) if key in schema]
    parts = [*schema.get("prefixItems", ()), schema.get("items")]
    each = {allowed(part, definitions) for part in parts if isinstance(part, dict)} - {""}
    words += [f"each {one}" for one in sorted(each)]
    words += [allowed(one, definitions) for one in schema.get("anyOf", ())]
    return ", ".join(filter(None, words))


def shown(number):
    """Return a bound with eight digits."""
    return "" if number is None else str(number) if isinstance(number, int) else f"{number:.8g}"


def rows(schema, definitions, before=""):
    """Yield key, default, allowed values and description of every key, and of those of the tables within."""
    for key, field in schema["properties"].items():
        if key in SHARED:
            continue
        has_to_be_given = key in schema.get("required", ())
        default = "none" if has_to_be_given else json.dumps(field.get("default", {}), ensure_ascii=False)
        yield f"{before}{key}", default, allowed(field, definitions), field["description"]
        for name in re.findall(r"#/\$defs/(\w+)", json.dumps(field)):
            if "properties" in definitions[name]:
                yield from rows(definitions[name], definitions, f"{before}{key}.")


def table():
    """Return the table: for each device its keys, and for each key default, allowed values and unit."""
    devices = {}
    for line in TABLE.read_text(encoding="utf-8").splitlines():
        if line.startswith("["):
            keys = {}
            devices |= dict.fromkeys(line.strip("[]").split(", "), keys)
        elif line:
            key, *rest = (part.strip() for part in line.split("  ;"))
            keys[key] = rest
    return devices


@pytest.mark.parametrize("driver", sorted(table()))
def test_keys_of_a_device_are_those_of_the_table(driver):
    schema = load("devices", driver).Settings.model_json_schema()
    keys = {key: (default, values, text) for key, default, values, text in rows(schema, schema.get("$defs", {}))}
    wanted = table()[driver]
    assert {key: [default, values] for key, (default, values, _) in keys.items()} == {
        key: [default, values] for key, (default, values, _) in wanted.items()
    }
    for key, (_, _, unit) in wanted.items():
        if unit != "-":
            assert re.search(rf"(?<![\w/]){re.escape(unit)}(?![\w/])", keys[key][2]), (key, unit)


def test_table_has_every_device_of_the_bench():
    own = {name for name, entry in entries("devices").items() if entry.own}
    assert own == set(table())
