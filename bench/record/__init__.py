"""The durable record of a run: one SQLite file, written before any observer is notified.

`Journal` writes it, `Record` reads it. Everything else, such as the .rrd file, tables and figures, is derived from it
and can be made again. The tables are described in `docs/reference/records.md`.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
