"""The parts of a run's page about models: loops, residuals, bands, densities, coefficients."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from bench.analysis.applied import Applied
from bench.analysis.applied_figures import draw_applied
from bench.analysis.figures.planes import plot_coverage, plot_densities
from bench.analysis.report.page.pages import PageFigure, PagePart, PageTable, PageText, inlined
from bench.base import Floats, fitting_prefix, percent, significant
from bench.identification import CoefficientUncertainties, ModelFile, coefficient_uncertainties
from bench.models import MemoryCurve, TimedModel

_FEW_COEFFICIENTS = 30
"""So many coefficients are listed one by one without being asked for."""


def models_parts(models: Sequence[Applied], times: Floats, scratch: Path) -> list[PagePart]:
    """Return loops and residuals of models, their errors, bands and coefficients.

    There is one model at least. `times`, shape (N,), has the laboratory time of each reading, s.
    """
    parts: list[PagePart] = [*errors_parts(models)]
    for i, group in enumerate(_by_signals(models)):
        parts += _fits(group, times, scratch, i)
    parts += [part for model in models for part in _bands(model)]
    for i, model in enumerate(models):
        has_time = isinstance(model.file.model, TimedModel)
        parts += _details_in_time(model, scratch, i) if has_time else _details(model, scratch, i)
    return parts


def given_parts(files: Mapping[str, ModelFile], scratch: Path) -> list[PagePart]:
    """Return the models that a run was given, by the parameter that names each, with their densities."""
    rows, figures = [], list[PageFigure]()
    for i, (parameter, file) in enumerate(files.items()):
        source = file.provenance.get("source") or ", ".join(file.provenance.get("sources", ()))
        band = "none" if file.band is None else f"{100.0 * file.band.level:g} %"
        known = "" if file.validity is None else file.validity.text(file.response.input_unit)
        rows.append((parameter, file.name, file.model.kind, str(source), known, band))
        figures += _densities(file, scratch, f"given-{i}", ", as the run was given it")
    heads = ("parameter", "model", "kind", "identified from", "valid for inputs", "prediction band")
    return [PageTable(heads, rows), *figures] if rows else []


def _densities(file: ModelFile, scratch: Path, name: str, more: str = "") -> Iterator[PageFigure]:
    """Draw the densities of a model, under a name; their colours are values."""
    for i, density in enumerate(file.model.densities()):
        plot_densities(path := scratch / f"{name}-{i}.svg", [density])
        yield inlined(path, f"{f'Density of {file.name} {density.title}'.rstrip()}{more}.", is_map=True)


def errors_parts(models: Sequence[Applied]) -> list[PageTable | PageText]:
    """Return the errors of models, and what a reader should know of them."""
    if not models:
        return []
    rows = []
    for model in models:
        errors = model.errors()
        numbers = (errors.maximum, errors.rms, errors.average)
        factor, unit = fitting_prefix(model.unit, *numbers, least=0.1)
        cells = [significant(factor * number, 4) for number in numbers]
        rows.append(
            (
                model.file.name,
                model.file.model.kind,
                *cells,
                "" if unit == "1" else unit,
                percent(errors.rms_percent).removesuffix(" %"),
            )
        )
    heads = ("model", "kind", "max", "RMS", "mean absolute", "unit", "RMS / % of range")
    table = PageTable(heads, rows, title="models on this run", numbers_from=2)
    skip = models[0].first
    skipped = [f"readings 1 to {skip} drive the memory of the models and count in no error"] if skip else []
    remarks = [f"{model.file.name}: {text}" for model in models if (text := model.beyond.text())]
    return [table, *map(PageText, [*skipped, *remarks])]


def _by_signals(models: Sequence[Applied]) -> list[list[Applied]]:
    groups: dict[tuple[str, str], list[Applied]] = {}
    for model in models:
        assert model.measured is not None
        groups.setdefault((model.input.name, model.measured.name), []).append(model)
    return list(groups.values())


def _fits(models: Sequence[Applied], times: Floats, scratch: Path, number: int) -> Iterator[PageFigure]:
    first, by_name = models[0], {model.file.name: model for model in models}
    assert first.measured is not None
    paths = draw_applied(by_name, scratch / f"loops-{number}.svg", scratch / f"time-{number}.svg", times)
    shaded = " Shaded: prediction bands." if any(model.band for model in models) else ""
    for path, over in zip(paths, (first.input.title, "time"), strict=True):
        caption = (
            f"{first.measured.title} over {over}: measured (points) and {', '.join(by_name)} (lines); below, what "
            f"each leaves, on one scale.{shaded}"
        )
        yield inlined(path, caption)


def _bands(model: Applied) -> Iterator[PageTable | PageText]:
    if model.band is None:
        return
    covered = model.band.coverage(model.residuals[model.first :])
    rows = [*model.band.rows(), ("covers of the readings", f"{100.0 * covered:.1f} %")]
    yield PageTable(("", ""), rows, title=f"prediction band of {model.file.name}")


def _details(model: Applied, scratch: Path, number: int) -> Iterator[PagePart]:
    operator, name = model.file.operator, model.file.name
    inputs = model.input.values
    found = coefficient_uncertainties(operator, inputs, model.residuals, model.state, model.first)
    coverage = operator.coverage(inputs, model.state)
    cells = 0 if coverage is None else coverage.swept.size
    for i, density in enumerate(operator.densities()):
        path = scratch / f"density-{number}-{i}.svg"
        sigma = found.sigmas[:cells] if found.sigmas is not None and _is_one_plane(model, cells) else None
        plot_densities(path, [density], None if coverage is None else coverage.swept, uncertainties=sigma)
        caption = f"Density of {name}"
        if coverage is not None:
            caption += f"; {coverage.summary()} by this run"
        if sigma is not None:
            caption += "; beside it its standard uncertainty"
        yield inlined(path, f"{caption}.", is_map=True)
        if coverage is not None and isinstance(memory := model.file.memory, MemoryCurve):
            path = scratch / f"coverage-{number}-{i}.svg"
            plot_coverage(path, density, coverage.swept, memory)
            caption = f"What this run swept of the plane of {name}, and the memory at the end of the model's data."
            yield inlined(path, caption, is_map=True)
    yield _coefficients(model, found, cells)


def _details_in_time(model: Applied, scratch: Path, number: int) -> Iterator[PageFigure | PageTable]:
    yield from _densities(model.file, scratch, f"density-{number}")
    rows = [(name, f"{value:.6g}", unit) for name, (value, unit) in model.file.model.parameters().items()]
    heads = ("parameter", "value", "unit")
    yield PageTable(heads, rows, title=f"parameters of {model.file.name}", numbers_from=1)


def _coefficients(model: Applied, found: CoefficientUncertainties, cells: int) -> PageTable:
    operator = model.file.operator
    values = operator.coefficients
    rows = [("bias", f"{operator.bias:.6g}", "")]
    for k, value in enumerate(values.tolist()):
        if k < cells and value == 0.0:
            continue
        sigma = "–" if found.sigmas is None or not np.isfinite(found.sigmas[k]) else significant(found.sigmas[k], 2)
        rows.append((_coefficient_name(model, k, cells), significant(value, 4), sigma))
    shape = operator.shape_parameters()
    rows += [(name, f"{value:.6g}", "") for name, value in zip(shape.names, shape.values, strict=True)]
    zeros = int(np.count_nonzero(values[:cells] == 0.0))
    note = f"{found.text}. {zeros} cells with zero density are left out." if zeros else f"{found.text}."
    shown = 2 if found.sigmas is None else 3
    return PageTable(
        ("coefficient", "value", "σ")[:shown],
        [row[:shown] for row in rows],
        title=f"coefficients of {model.file.name}",
        note=note,
        folded=len(rows) > _FEW_COEFFICIENTS,
        numbers_from=1,
    )


def _is_one_plane(model: Applied, cells: int) -> bool:
    """Return whether the first coefficients of a model are the cells of its only density."""
    densities = model.file.operator.densities()
    return len(densities) == 1 and cells == np.tril_indices(len(densities[0].values))[0].size


def _coefficient_name(model: Applied, k: int, cells: int) -> str:
    if k < cells and _is_one_plane(model, cells):
        levels = model.file.operator.densities()[0].levels
        i, j = (int(index[k]) for index in np.tril_indices(levels.size - 1))
        return f"density at β {levels[j]:g} to {levels[j + 1]:g}, α {levels[i]:g} to {levels[i + 1]:g}"
    return f"reversible part, coefficient {k - cells}" if cells else f"coefficient {k}"
