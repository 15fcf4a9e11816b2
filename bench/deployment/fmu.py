"""A model as a functional mock-up unit for co-simulation: description, source and a binary for Linux."""

from __future__ import annotations

import importlib.metadata
import tempfile
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias
from xml.sax.saxutils import quoteattr

from bench.base import DataError
from bench.deployment.c_source import compile_library, parts_of, rendered
from bench.deployment.export import deploy, ranges_of
from bench.identification import ModelFile
from bench.models import Coupled, Hammerstein
from bench.specimen import TwinTable

Version: TypeAlias = Literal["2.0", "3.0"]
What: TypeAlias = Literal["operator", "inverse", "specimen"]

_KINDS = (
    "Float32",
    "Int8",
    "UInt8",
    "Int16",
    "UInt16",
    "UInt32",
    "Int64",
    "UInt64",
    "Boolean",
    "String",
    "Binary",
    "Clock",
)
_OTHERS = """
EnterConfigurationMode ExitConfigurationMode EnterEventMode EnterStepMode EnterContinuousTimeMode
CompletedIntegratorStep SetTime SetContinuousStates GetContinuousStateDerivatives GetEventIndicators
GetContinuousStates GetNominalsOfContinuousStates GetNumberOfEventIndicators GetNumberOfContinuousStates
ActivateModelPartition GetOutputDerivatives GetDirectionalDerivative GetAdjointDerivative
GetNumberOfVariableDependencies GetVariableDependencies UpdateDiscreteStates EvaluateDiscreteStates
GetIntervalDecimal GetIntervalFraction SetIntervalDecimal SetIntervalFraction GetShiftDecimal GetShiftFraction
SetShiftDecimal SetShiftFraction
"""
_UNUSED = [f"{way}{kind}" for kind in _KINDS for way in ("Get", "Set")] + _OTHERS.split()
"""Functions of FMI 3.0 that a unit for co-simulation without events has, and that do nothing."""
_TIME = '    <Float64 name="time" valueReference="6" causality="independent" variability="continuous"/>'
"""The variable that version 3.0 has beside those of the model."""


@dataclass(frozen=True)
class _Variable:
    """A variable of the description; `reference` is its place, see `fmu.c.in`."""

    name: str
    reference: int
    causality: str
    unit: str = ""
    start: float | int | None = None
    whole: bool = False


def write_fmu(
    file: ModelFile | TwinTable,
    path: Path,
    *,
    what: What = "operator",
    version: Version = "2.0",
    period: float | None = None,
) -> None:
    """Write a model, its inverse, or the specimen of a twin as a functional mock-up unit for co-simulation.

    An operator has the input `u` and the output `y`; its inverse `target`, and `u`, `y` at `u` and `reach` (1 too
    high, -1 too low). A model from voltage and force to length has these names. The parameter `start` chooses the
    memory: 0 at the end of the fitted data, 1 before them (the default), 2 and 3 negative and positive saturation.
    A specimen has the set-point `u`, and gives `drive` and `y`, without the noise of readings. Its parameter `seed`
    chooses the session, and its communication steps are whole multiples of the step of the twin.

    Parameters
    ----------
    file : ModelFile or TwinTable
        The model; of a specimen what the rig file of the twin says in `[emulation]`.
    path : Path
        File to write, `.fmu`.
    what : {"operator", "inverse", "specimen"}
        What of it; of a twin always the specimen.
    version : {"2.0", "3.0"}
        Version of FMI.
    period : float, optional
        Time of a step, s, for a model with time; every communication step then has it.

    Raises
    ------
    ConfigurationError
        If there is no compiler of C, or the period does not suit the model.
    DataError
        If the model cannot be exported, or the file not written.
    """
    specimen = None
    if isinstance(file, TwinTable):
        specimen, what = file, "specimen"
        file = ModelFile(path.stem, specimen.operator)
    found = deploy(file, real="double", period=period, specimen=specimen)
    if specimen is not None:
        period = specimen.step
    coupled = isinstance(file.model, Coupled)
    variables = _variables(file, what, None if specimen is None else specimen.drive.rest)
    words = {
        "title": f"Model {file.name}, {what}",
        "identity": f"SHA-256 of the model: {found.digest}",
        "name": found.name,
        "guid": found.digest,
        **_actions(what, coupled, period, variables),
        "none": "\n".join(f"NONE(fmi3{name})" for name in _UNUSED),
    }
    template = parts_of("fmu.c.in")
    fmi = f"fmi{version[0]}"
    files = {name: text for name, text in found.files.items() if name in (f"{found.name}.h", f"{found.name}.c")} | {
        f"{fmi}.c": rendered(template["head"] + template[fmi], "double", found.name, found.name, words)
    }
    binary = "binaries/linux64" if version == "2.0" else "binaries/x86_64-linux"
    content = {f"sources/{name}": text.encode() for name, text in files.items()}
    content["modelDescription.xml"] = _description(
        version, file, found.digest, variables, period, sorted(files)
    ).encode()
    content["documentation/README.md"] = found.files["README.md"].encode()
    if version == "3.0":
        content["sources/buildDescription.xml"] = _build_description(sorted(files)).encode()
    content[f"{binary}/model.so"] = _compiled(files)
    try:
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, data in content.items():
                # Without the time of day: the same model gives the same bytes.
                archive.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), data)
    except OSError as error:
        raise DataError(f"--fmu {path} cannot be written: {error.strerror}") from None


def _compiled(files: Mapping[str, str]) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder, name) for name in files]
        for path, text in zip(paths, files.values(), strict=True):
            path.write_text(text, encoding="utf-8")
        library, sources = Path(folder, "model.so"), [path for path in paths if path.suffix == ".c"]
        compile_library("--fmu", sources, library, "-fvisibility=hidden")
        return library.read_bytes()


def _variables(file: ModelFile, what: What, rest: float | None) -> list[_Variable]:
    *inputs, (_, _, output) = ranges_of(file.model)
    coupled = isinstance(file.model, Coupled)
    first, last = ("voltage", "length") if coupled else ("u", "y")
    unit = inputs[0][2]
    found = [_Variable("start" if rest is None else "seed", 5, "parameter", start=1, whole=True)]
    if rest is not None:
        found += [_Variable("u", 0, "input", unit, rest), _Variable("drive", 2, "output", unit)]
        found.append(_Variable("y", 3, "output", output))
    elif what == "operator":
        found += [_Variable(first, 0, "input", unit, _begin(file)), _Variable(last, 2, "output", output)]
    else:
        target = 0.5 * sum(ranges_of(file.model)[-1][1])
        found += [_Variable("target", 0, "input", output, target), _Variable(first, 2, "output", unit)]
        found += [_Variable(last, 3, "output", output), _Variable("reach", 4, "output", whole=True)]
    if coupled:
        found.append(_Variable("force", 1, "input", inputs[1][2], float(file.model.pretension)))
    return found


def _begin(file: ModelFile) -> float:
    """Return the input at which a model starts."""
    model: Any = file.model
    if isinstance(model, Coupled):
        return float(ranges_of(model)[0][1][0])
    operator = model.static if isinstance(model, Hammerstein) else model
    initial = getattr(file.initial, "memory", file.initial)
    return float(operator.present_input(operator.initial_state() if initial is None else initial))


def _actions(what: What, coupled: bool, period: float | None, variables: list[_Variable]) -> dict[str, str]:
    load = ", load" if coupled else ""
    starts = {each.reference: each.start for each in variables if each.causality == "input"}
    check = (
        "" if period is None else f"    if (step < {0.999 * period!r} || step > {1.001 * period!r}) return FAILED;\n"
    )
    most = "3"
    if what == "specimen":
        # In whole steps of the grid.
        check = f"    if (step < {0.999 * (period or 0.0)!r}) return FAILED;\n"
        begin, most = "i->state.drive", "INT32_MAX"
        advance = [
            f"long left = (long)(step / {period!r} + 0.5);",
            f"if (step - (double)left * {period!r} > 1e-6 || (double)left * {period!r} - step > 1e-6) return FAILED;",
            "for (; left > 0; --left) i->outputs[1] = BASE_step(&i->state, u);",
            "i->outputs[0] = i->state.drive;",
        ]
    elif what == "operator":
        begin, advance = "i->outputs[1]", [f"i->outputs[0] = i->outputs[1] = BASE_step(&i->state, u{load});"]
    else:
        given = ", i->inputs[1]" if coupled else ""
        begin = f"BASE_invert(&i->state, i->outputs[1]{given}).setpoint"
        advance = [
            "{",
            f"    BASE_answer answer = BASE_invert(&i->state, u{load});",
            f"    if (answer.count == 2) BASE_step(&i->state, answer.saturating{load});",
            f"    i->outputs[1] = BASE_step(&i->state, answer.setpoint{load});",
            "    i->outputs[0] = answer.setpoint;",
            "    i->reach = answer.reach;",
            "}",
        ]
    return {
        "begin": begin,
        "most": most,
        "check": check,
        "advance": "\n".join(f"    {line}" for line in advance),
        "inputs": f"{float(starts[0] or 0.0)!r}, {float(starts.get(1) or 0.0)!r}",
    }


def _attributes(**values: object) -> str:
    return " ".join(
        f"{name}={quoteattr(str(value).lower() if isinstance(value, bool) else str(value))}"
        for name, value in values.items()
        if value not in (None, "")
    )


def _description(
    version: Version,
    file: ModelFile,
    guid: str,
    variables: list[_Variable],
    period: float | None,
    sources: list[str],
) -> str:
    """Return the model description; version 3 names the sources in a file of their own."""
    is_old = version == "2.0"
    units = sorted({each.unit for each in variables if each.unit})
    unit_lines = "".join(f"<Unit name={quoteattr(unit)}/>" for unit in units)
    lines = [] if is_old else [_TIME]
    for each in variables:
        is_parameter = each.causality == "parameter"
        attributes = _attributes(
            name=each.name, valueReference=each.reference, causality=each.causality,
            variability="fixed" if is_parameter else "discrete",
            initial={"parameter": "exact", "output": "calculated"}.get(each.causality),
        )  # fmt: skip
        own = _attributes(unit=each.unit, start=each.start)
        if is_old:
            kind = "Integer" if each.whole else "Real"
            lines.append(f"    <ScalarVariable {attributes}><{kind} {own}/></ScalarVariable>")
        else:
            lines.append(f"    <{'Int32' if each.whole else 'Float64'} {attributes} {own}".rstrip() + "/>")
    # By their places in version 2, by their references in version 3.
    outputs = [i if is_old else v.reference for i, v in enumerate(variables, start=1) if v.causality == "output"]
    if is_old:
        unknowns = "".join(f'<Unknown index="{index}"/>' for index in outputs)
        structure = [f"    <Outputs>{unknowns}</Outputs><InitialUnknowns>{unknowns}</InitialUnknowns>"]
    else:
        structure = [f'    <{k} valueReference="{r}"/>' for k in ("Output", "InitialUnknown") for r in outputs]
    saved = "canGetAndSetFMUstate" if is_old else "canGetAndSetFMUState"
    serialized = "canSerializeFMUstate" if is_old else "canSerializeFMUState"
    abilities = _attributes(
        modelIdentifier="model",
        canHandleVariableCommunicationStepSize=period is None,
        **{saved: True, serialized: True},
    )
    listed = "".join(f'<File name="{name}"/>' for name in sources if name.endswith(".c"))
    head = _attributes(
        fmiVersion=version,
        modelName=file.name,
        **{"guid" if is_old else "instantiationToken": guid},
        generationTool=f"actuator-bench {importlib.metadata.version('actuator-bench')}",
        variableNamingConvention="flat",
    )
    return "\n".join(
        [
            '<?xml version="1.0" encoding="UTF-8"?>',
            f"<fmiModelDescription {head}>",
            f"  <CoSimulation {abilities}>"
            + (f"<SourceFiles>{listed}</SourceFiles>" if is_old else "")
            + "</CoSimulation>",
            *([f"  <UnitDefinitions>{unit_lines}</UnitDefinitions>"] if units else []),
            f'  <DefaultExperiment startTime="0" stopTime="1" stepSize="{period or 0.01!r}"/>',
            "  <ModelVariables>",
            *lines,
            "  </ModelVariables>",
            "  <ModelStructure>",
            *structure,
            "  </ModelStructure>",
            "</fmiModelDescription>",
            "",
        ]
    )


def _build_description(sources: list[str]) -> str:
    files = "".join(f'<SourceFile name="{name}"/>' for name in sources if name.endswith(".c"))
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<fmiBuildDescription fmiVersion="3.0">\n'
        '  <BuildConfiguration modelIdentifier="model">\n'
        f'    <SourceFileSet language="C99">{files}</SourceFileSet>\n'
        "  </BuildConfiguration>\n</fmiBuildDescription>\n"
    )
