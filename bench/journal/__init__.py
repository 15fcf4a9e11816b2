"""The durable record of a run: one SQLite file, written before any observer is notified.

The file is in WAL mode with synchronous=FULL, and every step and event is committed when it is handed over, with the
telemetry before it; what `Journal` has returned from survives a crash of the process and of the machine. On the
virtual clock it is synchronous=NORMAL: a crash of the machine may take the last rows, but damages nothing. Everything
else (the .rrd, tables, figures) is derived from it and can be made again. When it is closed it becomes one
self-contained file, which can be read where nothing can be written.

While a run goes on, a second file has every row once more (`bench.journal.mirror`). Where the journal cannot be
written, a row is durable in that one, and goes into the journal later; see docs/reference/journal.md.

Schema, version 3
-----------------
`meta(key, value, checksum)`
    Values are JSON. Keys: `schema`, `identity` (random number of the journal, which its second files have as well),
    `run` (identifier), `rig`, `rig_file` (its text), `rig_content` (with what it
    extends and the overrides), `overrides`, `protocol`, `protocol_source` (its module, whether that is of an
    installed package, and the checksum of its file), `parameters`, `changed` (those that differ from their defaults),
    `repeats` (the run that this one repeats), `slots` (device and signal by name), `seed`,
    `interlock_rate` (looks in a second beside the readings; null for none), `clock`, `epoch` (time of day at the
    start), `devices` (identity by name), `limits` (set-points that each takes), `calibration`, `operator`, `command`,
    `packages` (versions), `git` (commit and whether it was clean), `host` (with the wall-clock time at the start),
    `controls` (the signal under control), `plan` (as far as no reading decides), `rehearsal` (null if there was
    none), `dashboard`, `over_time` (signals whose plots over time are always visible), `rig_given` (name or path of
    the rig), `laboratory_epoch` (of a served laboratory), `resumes` (what each process was that took the run up after
    its death), `recovered` (of a copy that `bench recover-journal` wrote: from which journal, rows that are lost by
    table, and keys whose values stand for lost ones), and at the end `status` (`completed`, `aborted`, `failed`),
    `reason`, `finished` (laboratory s), `safe_state` (outcome by device), `counts` (rows by table). A file without
    `status` is of a run that is going on or whose process died; how that was may stand in the guardian's own record
    beside it (`bench.journal.ending`).
`signals(position, name, unit, description, precision, checksum)`
    One row a signal column of the two tables below.
`steps(step, started, finished, phase, label, settled, setpoints, "<signal>", …, seen, checksum)`
    One row a finished step, numbered from 0; times are laboratory s from the start of the run; `settled` says how
    (`dwell`, `steady`, `arrived`, `controlled`; `not steady` or `not arrived` in the step that ended a run);
    `setpoints` is JSON by device; then one REAL column a signal, the reading; `seen` is JSON: the times of the
    ticks that a controller was given, from which its state can be rebuilt.
`telemetry(tick, t, step, "<signal>", …, checksum)`
    One row a tick of a hold, numbered from 1: quick readings. `step` is that which the tick belongs to; -1 on the
    way back of a run that is resumed. A step that was not finished when its run died has ticks of both attempts.
`events(event, t, level, kind, text, checksum)`
    Phases, notes, pauses, suspensions of the machine, a time of day that was set, interlocks, errors, safe state, the
    factor that a paced clock reached; numbered from 1; level is `INFO`, `WARN` or `ERROR`.
`files(name, sha256, content)`
    The content of every file that the run was given.

`checksum` is the CRC-32 of the other columns of a row, see `bench.journal.rows.checksum`; a row whose checksum does
not fit is damaged.

Models that were identified from the run stand in files beside the journal, see `add_model`.
"""

from bench.journal.card import expected_steps, run_card
from bench.journal.ending import BLACK_BOX_NAME, Ending, ending_of
from bench.journal.finding import files_of, find_journals
from bench.journal.models import add_model
from bench.journal.record import Record
from bench.journal.rows import FILE_NAME, SCHEMA, Event, StepRecord
from bench.journal.table import Table
from bench.journal.writing import Journal, abandon, take_in

__all__ = [
    "BLACK_BOX_NAME",
    "FILE_NAME",
    "SCHEMA",
    "Ending",
    "Event",
    "Journal",
    "Record",
    "StepRecord",
    "Table",
    "abandon",
    "add_model",
    "ending_of",
    "expected_steps",
    "files_of",
    "find_journals",
    "run_card",
    "take_in",
]
