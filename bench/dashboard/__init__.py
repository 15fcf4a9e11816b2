"""The live view of a run and its .rrd file, by Rerun; both are derived from the journal.

The pages of the view are described in `docs/reference/dashboard.md`.
"""

# The first that loads Rerun.
from bench.dashboard import _rerun_log as _rerun_log  # isort: skip
from bench.dashboard.from_journal import JournalView, rebuild
from bench.dashboard.live import Dashboard
from bench.dashboard.screenshot import picture
from bench.dashboard.viewers import check_address, has_display, open_viewer, web_viewer

__all__ = [
    "Dashboard",
    "JournalView",
    "check_address",
    "has_display",
    "open_viewer",
    "picture",
    "rebuild",
    "web_viewer",
]
