"""The pytest plugin behind `pytest --pyargs bench.contracts`; any other call of pytest is left as it is."""

from __future__ import annotations

import pytest


def pytest_load_initial_conftests(early_config: pytest.Config, args: list[str]) -> None:
    """Add the options of the contracts where the contracts are asked for."""
    if any(argument.partition("::")[0].startswith("bench.contracts") for argument in args):
        early_config.pluginmanager.import_plugin("bench.contracts.on_a_rig")
