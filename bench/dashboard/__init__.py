"""The live view of a run and its .rrd file, both by Rerun, both derived from the content of the journal.

The control thread only puts what happened into a queue. One thread takes it out about once a second and hands it to
Rerun in columns, which costs a twentieth of logging row by row; the same code rebuilds an .rrd from a journal, and
follows one that another process writes. A viewer connects to a server of this process, bound to the loopback address.

Rerun keeps an index of each portion of a file in memory until the file is complete, so the portions grow with the
run. Views are arranged anew when there is something new to show, or the error has another scale.

File and live view are two streams of one recording, so that a stalled viewer cannot delay the file. Rerun keeps the
data that such a viewer does not read, some 8 kB for each batch of a quantity, until its channel is full; the live
view is then suspended until the viewer resumes, and the log says so.

The queue is bounded, too. If Rerun itself stalls, because a disk does, telemetry is dropped beyond `QUEUED_TICKS`
entries and everything beyond `QUEUED_ENTRIES`; the log says how much. Nothing of the record is lost by any of this:
`rebuild` makes the whole .rrd from the journal.

What is recorded, on the timelines `t` (laboratory time) and `step`
--------------------------------------------------------------------
`/signals/QUANTITY`, `/readings/QUANTITY`
    One vector a unit: quick readings of each tick, and the reading of each step.
`/signals/QUANTITY/bounds/N`
    A limit, an interlock or a warning, once the signals are near.
`/control/tracking`, `/control/error`, `/control/disturbance`
    Of a run under control, one vector each: reference, predicted output and output; output less reference; the
    estimated disturbance. The latter two have a band of two standard deviations of that estimate. nan while no
    controller is at work.
`/control/error/targets`
    The mean error at each target.
`/control/error/band`, `/signals/QUANTITY/band`
    The prediction band of a model: under control less the reference, in the unit of the error, otherwise at each
    reading. Lower and upper end where the input is of the class of the calibration, else nan; the same where it is
    of another one or not judged yet; the model's own prediction.
`/signals/QUANTITY/setpoint_band`
    The band about the set-points of the model's input: the first four of these.
`/loop/data/path`, `/loop/data/recent`, `/loop/data/now`
    Output against input: the line from each point to the next, pale under control, when the same is there once more
    for the last targets; and the last point. Further plots are `/loops/0`, `/loops/1` ...
`/plane/data/memory`, `/plane/data/input`, `/plane/density`
    The Preisach plane: the memory curve at each point, the input on the diagonal, the model's density.
`/planes/NAME/density`, `/planes/NAME/data/memory`, `/planes/NAME/data/input`
    The same of a density over another input, on a plane of its own.
`/numbers`
    The panel of numbers.
`/state/phase`, `/state/run`
    Phase and state of the protocol: changes only.
`/events`, `/card`
    The log, and the run card.
"""

# The first that loads Rerun.
from bench.dashboard import _rerun_log as _rerun_log  # isort: skip
from bench.dashboard.from_journal import rebuild
from bench.dashboard.live import Dashboard
from bench.dashboard.screenshot import picture

__all__ = ["Dashboard", "picture", "rebuild"]
