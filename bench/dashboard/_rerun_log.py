"""Loads Rerun with a log without the failures of its file writer, which the bench says in a line of its own.

Rerun reads the filter of its log from `RUST_LOG` when it is loaded (`default_log_filter` of its crate `re_log`), and
has no other way to set it. A `RUST_LOG` of the user's own is left as it is; other processes do not see this one.
"""

import os

FILTER = "warn,re_log_encoding::rrd=off,re_sdk::recording_stream=off"
"""All warnings and errors but those of writing a file, and of letting go of one that could not be written."""

if "RUST_LOG" in os.environ:
    import rerun
else:
    os.environ["RUST_LOG"] = FILTER
    try:
        import rerun
    finally:
        del os.environ["RUST_LOG"]

__all__ = ["FILTER", "rerun"]
