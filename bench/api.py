"""The bench for scripts and notebooks: the functions that `import bench` offers.

>>> import bench
>>> with bench.open_rig("vo2") as rig:  # on its virtual clock, as it is emulated
...     status = rig.devices["tec"].set(40.0)
...     status.wait()
...     print(round(rig.measure()["tec_temperature"]))
40

Leaving the block brings every device into its safe state before its line is closed.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

from bench.analysis import (
    ALL,
    FEWEST_ROWS,
    ColumnNames,
    FitOptions,
    IdentifiedFile,
    InvertedTargets,
    ReadingOptions,
    Report,
    RunComparison,
    RunFolder,
    RunTable,
    compare_runs,
    identify_best,
    identify_model,
    input_and_output,
    invert_targets,
    is_comparison,
    list_runs,
    named_models,
    predict as predict_file,
    read_dataset,
    report_run,
    select_runs,
    time_names,
)
from bench.base import ConfigurationError, DeviceError, PlainConsole, VirtualClock, show_patience, wall_time
from bench.batch import published_of
from bench.deployment import Deployment, Real, controller_of_rig, deploy as export_model
from bench.execution import Rehearsal, Run, carry_out, foresee
from bench.identification import ModelFile, load_model
from bench.protocol import ProtocolDefinition, find_protocol
from bench.record import Record
from bench.rig import SAFE, Rig, clock_for, load_rig

Model: TypeAlias = IdentifiedFile | ModelFile | Path | str
"""What a model may be given as: the result of `identify` or `load`, or a model file."""


def open_rig(
    rig: str | Path, *, seed: int = 0, clock: str | None = None, overrides: Mapping[str, str] | None = None
) -> Rig:
    """Connect a rig.

    Parameters
    ----------
    rig : str or Path
        Name of an installed rig, or path of a rig file.
    seed : int
        Seed of all that is random in an emulated laboratory.
    clock : str, optional
        `wall`, `virtual` or `xN`; if not given, `virtual` where all instruments are emulated in this process,
        else `wall`. There `wall` and `xN` slow down when the process is late, rather than run ahead of it.
    overrides : mapping of str to str, optional
        Values of the rig file to replace, by dotted key.

    Returns
    -------
    Rig
        A context manager: leaving it makes every device safe, then closes its line.

    Raises
    ------
    ConfigurationError
        If the rig file is wrong.
    DeviceError
        If a device cannot be connected; nothing has moved.
    """
    file = load_rig(str(rig), overrides)
    passing = clock_for(file, clock or ("virtual" if file.in_process else "wall"))
    if isinstance(passing, VirtualClock):
        # Time stamps that stand beside those of another program, such as bluesky's, count from today.
        passing.go_on(wall_time(), 0.0)
    return Rig(file, passing, seed)


def run(
    protocol: str | ProtocolDefinition,
    rig: str | Path,
    *,
    out: str | Path = "recordings",
    seed: int = 0,
    clock: str | None = None,
    overrides: Mapping[str, str] | None = None,
    accuracy: float | str | None = None,
    live: bool = False,
    recording: bool = False,
    progress: bool = False,
    **parameters: Any,  # noqa: ANN401 - each protocol names and types its own
) -> RunFolder:
    """Carry out a protocol on a rig, record it, make every device safe, and return what was recorded.

    Parameters
    ----------
    protocol : str or ProtocolDefinition
        Name, `path/to/file.py[:NAME]`, or the protocol itself.
    rig : str or Path
        Name of an installed rig, or path of a rig file.
    out : str or Path
        Where the folder of the run is made.
    seed, clock, overrides
        As for `open_rig`.
    accuracy : float or str, optional
        Largest expanded uncertainty (95 %) of the controlled signal that is accepted, in its unit or with one, such
        as `'20 µm'`. A run whose uncertainty budget does not support it is refused before anything moves.
    live : bool
        Whether to serve the live view on the loopback interface.
    recording : bool
        Whether to write the recording for the viewer while the run goes on.
    progress : bool
        Whether to print the progress.
    **parameters
        Parameters of the protocol; the others have the rig's defaults or its own.

    Raises
    ------
    BenchError
        If anything is wrong before the start, the run does not complete, or the safe state is not confirmed; what
        was recorded is kept, and the error names its folder.

    Examples
    --------
    >>> folder = getfixture("tmp_path")
    >>> found = run("creep", "vo2", out=folder, hot=70.0, cool=50.0, duration=8.0)
    >>> found.status, len(found.readings)
    ('completed', 35)
    >>> round(float(found.readings["tec_temperature"].max()))
    70
    """
    definition = find_protocol(protocol) if isinstance(protocol, str) else protocol
    result = carry_out(
        Run(
            protocol=definition,
            settings=parameters,
            rig=str(rig),
            folder=Path(out),
            overrides=overrides or {},
            seed=seed,
            clock=clock,
            accuracy=None if accuracy is None else str(accuracy),
            live=live,
            recording=recording,
        ),
        PlainConsole(quiet=not progress),
    )
    outcome = result.outcome
    unsafe = ", ".join(name for name, state in outcome.safe_state.items() if state != SAFE)
    error = outcome.error or (DeviceError(unsafe, "NOT in its safe state") if unsafe else None)
    if error is not None:
        error.add_note(f"recorded in {result.folder}" + (f"; NOT in its safe state: {unsafe}" if unsafe else ""))
        raise error
    return RunFolder(result.folder)


class Table(Protocol):
    """Columns of measurements by their heads, such as a dictionary of arrays or a data frame."""

    def keys(self) -> Iterable[Any]:
        """Return the heads; a unit at the end, as in `force [N]`, is that of the column."""

    def __getitem__(self, name: Any, /) -> Any:  # noqa: ANN401 - what holds the values of a column
        """Return the values of a column."""


def identify(
    source: RunFolder | str | Path | Sequence[RunFolder | str | Path] | Table,
    model: str | None = None,
    *,
    input: str | None = None,  # noqa: A002 - the word of the command line
    output: str | None = None,
    **options: Any,  # noqa: ANN401 - each model names and types its own
) -> IdentifiedFile:
    """Identify a model from measurements: of a run, of a file, of several of them, or in memory.

    Parameters
    ----------
    source : RunFolder, str, Path, a list of them, or Table
        A run, or a table of measurements: text, .gz, .mat, .h5, .tdms, .npz, .npy, .parquet, .json or a spreadsheet;
        or a dictionary of arrays or a data frame. Several are taken one after another.
    model : str, optional
        Name of a registered model; several with commas between them, or all of one input if there is none, are
        compared by what is left out of their fits, and one of them is chosen.
    input, output : str, optional
        Columns, by name or by number from 1; of a run, the signals of its slots `drive` and `response` if not given.
    **options
        As in `bench.analysis.FitOptions`: `smoothing`, `skip`, `cross_validated`, `initial`, `orientation`, and the
        options of the model; `time_column` for a model with time and `weights_column`; and those of `ReadingOptions`
        where the layout of a file is not found from it: `delimiter`, `decimal`, `encoding`, `skip_lines`, `table`,
        `interval`, `time_unit`, `missing`.

    Raises
    ------
    DataError
        If the measurements cannot be used.
    ConfigurationError
        If there is no such model, an option does not belong to it, or a column is not given: names those there are.

    Examples
    --------
    >>> folder = getfixture("tmp_path")
    >>> measured = run("damped-oscillation", "vo2", out=folder, increment=3.0, half_cycles=8)
    >>> model = identify(measured, "preisach-nonmonotonic", levels=8, plane=(30.0, 70.0))
    >>> model.identification.errors.rms_percent < 5.0
    True
    >>> curvature = predict(model, [21.0, 60.0, 66.0, 62.0])
    >>> curvature.shape
    (4,)
    >>> invert(model, [500.0, 900.0]).flags
    ('met', 'met')
    """
    table: dict[str, npt.ArrayLike] | None = None
    if isinstance(source, (RunFolder, str, Path)):
        paths = [_folder(source)]
    elif isinstance(source, Sequence):
        if not source:
            raise ConfigurationError("expected a run, a file or a table; the list of them is empty")
        paths = [_folder(part) for part in source]
    else:
        paths, table = [Path("the table")], {str(name): source[name] for name in source.keys()}  # noqa: SIM118
    reading = ReadingOptions(
        **{field.name: options.pop(field.name) for field in fields(ReadingOptions) if field.name in options}
    )
    time = options.pop("time_column", None)
    model = model or ALL
    is_compared = is_comparison(model)
    times = time_names(paths[0]) if is_compared and time is None and len(paths) == 1 else ()
    columns = input_and_output(paths[0], (input or "", output or ""), reading, table)
    names = ColumnNames(*columns, time, options.pop("weights_column", None), times)
    with show_patience(f"reading and fitting {paths[0].name}", PlainConsole(stderr=True)):
        data = read_dataset(paths, names, reading, at_least=FEWEST_ROWS, table=table)
        if not is_compared:
            return identify_model(data, model, FitOptions.of(options)).with_uncertainty()
        data = data if time is not None else data.with_usable_times()
        return identify_best(data, named_models(model), FitOptions.of(options))[0]


def predict(
    model: Model,
    inputs: npt.ArrayLike,
    *,
    times: npt.ArrayLike | None = None,
    initial: str | None = None,
    continue_memory: bool = False,
) -> npt.NDArray[np.float64]:
    """Return the outputs of a model for a sequence of inputs, shape (N,), in its units.

    Parameters
    ----------
    model : IdentifiedFile, ModelFile, Path or str
        The model.
    inputs : array_like, shape (N,)
        Inputs in the unit of the model.
    times : array_like, shape (N,), optional
        s, strictly increasing, for a model with time.
    initial : {"file", "negative", "positive"}, optional
        The memory before the first input: that at the start of the model's own data (if not given), or saturation at
        the low or the high end of the operating range.
    continue_memory : bool
        Whether to start from the memory at the end of the model's own data instead.

    Raises
    ------
    DataError
        If a model file cannot be read.
    ConfigurationError
        If a model with time has no times.
    """
    values = np.asarray(inputs, dtype=np.float64)
    moments = None if times is None else np.asarray(times, dtype=np.float64)
    return predict_file(_model(model), values, initial=initial, continue_memory=continue_memory, times=moments)


def invert(
    model: Model,
    targets: npt.ArrayLike,
    *,
    times: npt.ArrayLike | None = None,
    initial: str | None = None,
    continue_memory: bool = False,
) -> InvertedTargets:
    """Return the set-points that bring a model's output to one target after another; see `InvertedTargets`.

    Parameters
    ----------
    model, times, initial, continue_memory
        As for `predict`.
    targets : array_like, shape (N,)
        Targets in the unit of the model's output.

    Raises
    ------
    DataError
        If a model file cannot be read, or the model has several inputs.
    ConfigurationError
        If a model with time has no times or another one has, or it has no inverse at these times.
    """
    values = np.asarray(targets, dtype=np.float64)
    moments = None if times is None else np.asarray(times, dtype=np.float64)
    return invert_targets(_model(model), values, initial=initial, continue_memory=continue_memory, times=moments)


def deploy(
    model: Model,
    folder: Path | str,
    *,
    name: str = "model",
    real: Real = "float",
    period: float | None = None,
    max_bytes: int | None = None,
    controller: str | None = None,
    rig: str | Path | None = None,
    tuning: Path | str | None = None,
) -> Deployment:
    """Write a model, its inverse and its memory as C99 into a folder, which is made; return what was written.

    Parameters
    ----------
    model : IdentifiedFile, ModelFile, Path or str
        The model.
    folder : Path or str
        Where header, source, example and README are written.
    name : str
        Prefix of the functions, and name of the files; an identifier of C.
    real : {"float", "double"}
        Type of the numbers.
    period : float, optional
        Time of a step, s, of a controller or a model with time.
    max_bytes : int, optional
        Most bytes of code and constants.
    controller : str, optional
        Controller to write too: `follow.closed-loop-inverse` or `follow.open-loop-inverse` of `following`,
        `target.closed-loop-inverse` or `target.open-loop-inverse` of `tracking`. It needs a rig.
    rig : str or Path, optional
        Name or file of the rig whose limits and rest set-point the controller has.
    tuning : Path or str, optional
        Tuning file of the controller.

    Raises
    ------
    ConfigurationError
        If an argument does not suit the model or the controller, or more bytes are needed.
    DataError
        If the model cannot be read or exported, or the folder not be written.

    Examples
    --------
    >>> from bench.models import Preisach
    >>> film = ModelFile("film", Preisach([20.0, 45.0, 70.0], [1.0, 0.5, 2.0]))
    >>> written = deploy(film, getfixture("tmp_path") / "firmware", name="film")
    >>> sorted(written.files), written.state < 1024
    (['README.md', 'film.c', 'film.h', 'main.c'], True)
    """
    if (controller is None) != (rig is None) or (tuning is not None and controller is None):
        raise ConfigurationError("controller and rig belong together, and tuning to them")
    exported = None
    if controller is not None and rig is not None:
        exported = controller_of_rig(controller, str(rig), period, None if tuning is None else Path(tuning))
        period = None
    found = export_model(_model(model), name=name, real=real, period=period, max_bytes=max_bytes, controller=exported)
    found.write(Path(folder))
    return found


def load(path: str | Path) -> RunFolder | ModelFile:
    """Return a run (a folder or its journal) or a model (a `.json` file).

    Raises DataError if it is neither, or cannot be read.
    """
    if Path(path).suffix == ".json":
        return load_model(Path(path))
    found = RunFolder(Path(path))
    # Reads the journal, so that a wrong path is found here.
    _ = found.status
    return found


def report(source: RunFolder | str | Path, models: Sequence[Model] = ()) -> Report:
    """Print tables of a run, draw its figures and write its page `report.html`; return the same for programs.

    A notebook shows the page, figures included, in the place of the tables.

    Parameters
    ----------
    source : RunFolder, str or Path
        The run.
    models : sequence of IdentifiedFile, ModelFile, Path or str
        Models to try on it, beside those that were identified from it.

    Raises
    ------
    DataError
        If the run or a model cannot be read.
    """
    folder = _folder(source)
    published = published_of(folder)
    console = PlainConsole()
    console.quiet = console.is_jupyter
    found = report_run(folder, [_model(model) for model in models], None, console, published=published)
    return Report(found)


def rehearse(
    protocol: str | ProtocolDefinition,
    rig: str | Path,
    *,
    seed: int = 0,
    overrides: Mapping[str, str] | None = None,
    **parameters: Any,  # noqa: ANN401 - each protocol names and types its own
) -> Rehearsal:
    """Return what a run would do and touch, as found on the emulated twin of its rig; nothing moves.

    Parameters
    ----------
    protocol, rig, seed, overrides, **parameters
        As for `run`.

    Raises
    ------
    BenchError
        If anything is wrong before the start.

    Examples
    --------
    >>> found = rehearse("creep", "vo2", hot=70.0, cool=50.0, duration=8.0)
    >>> found.status, found.steps
    ('completed', 35)
    """
    definition = find_protocol(protocol) if isinstance(protocol, str) else protocol
    asked = Run(definition, parameters, str(rig), Path(), overrides=overrides or {}, seed=seed)
    return foresee(asked, PlainConsole(stderr=True))


def runs(
    folder: str | Path = "recordings",
    *,
    status: str | None = None,
    protocol: str | None = None,
    rig: str | None = None,
    **where: Any,  # noqa: ANN401 - each protocol names and types its own
) -> RunTable:
    """Return the runs below a folder, the oldest first; a notebook shows them as a table.

    Parameters
    ----------
    folder : str or Path
        Where they are.
    status, protocol, rig : str, optional
        What these have to be.
    **where
        Values that parameters have to have.

    Raises
    ------
    ConfigurationError
        If there is no such folder, or no run has such a parameter.
    """
    found = list_runs(Path(folder))
    wanted = {name: str(value) for name, value in where.items()}
    return RunTable(select_runs(found, wanted, status=status, protocol=protocol, rig=rig))


def compare(first: RunFolder | str | Path, second: RunFolder | str | Path) -> RunComparison:
    """Return what tells two runs apart, and how far their signals are apart.

    Raises DataError if one of them cannot be read.
    """
    with Record(_folder(first)) as ours, Record(_folder(second)) as theirs:
        return compare_runs(ours, theirs)


def _folder(source: RunFolder | str | Path) -> Path:
    return source.folder if isinstance(source, RunFolder) else Path(source)


def _model(model: Model) -> ModelFile:
    if isinstance(model, IdentifiedFile):
        return model.file
    return model if isinstance(model, ModelFile) else load_model(Path(model))
