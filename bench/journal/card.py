"""The page about a run for people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def run_card(meta: Mapping[str, Any]) -> str:
    """Return a run's metadata as a Markdown page, for the dashboard and the report."""
    lines = [
        f"# {meta['rig_title']}",
        "",
        f"**{meta['protocol']}** on **{meta['rig']}**: {meta['protocol_summary']}",
        "",
    ]
    lines += ["| | |", "|---|---|"]
    planned = meta["plan"]
    rows = {
        "run": meta["run"],
        "operator": meta["operator"],
        "started": f"{meta['epoch']} ({meta['clock']} clock)",
        "planned": f"{planned['steps']} steps, {planned['seconds'] / 3600:.2f} h",
        "seed": meta["seed"],
        **{f"device {name}": identity for name, identity in meta["devices"].items()},
        **{f"parameter {name}": value for name, value in meta["parameters"].items()},
        "git": meta["git"],
    }
    lines += [f"| {key} | {value} |" for key, value in rows.items()]
    return "\n".join(lines)
