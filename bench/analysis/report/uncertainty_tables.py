"""Uncertainties of a run in words and rows, for the terminal and for the page."""

from __future__ import annotations

from collections.abc import Mapping

from bench.analysis.report.page.pages import PageTable, PageText
from bench.analysis.uncertain_results import ControlUncertainty, RunUncertainty, rounded, two_digits
from bench.base import fitting_prefix, with_unit
from bench.rig import Budget

_MANY = 1000.0
"""Degrees of freedom that count as infinite. Derivation: Student's t then differs from the normal one by 0.1 %."""


def uncertainty_parts(found: RunUncertainty) -> list[PageTable | PageText]:
    """Return what is known of the uncertainties of a run, for the terminal and for the page."""
    parts: list[PageTable | PageText] = []
    for name, each in found.control.items():
        parts += [PageText(f"{name}: {line}") for line in _control_lines(each)]
    if found.shown is not None:
        budget = found.shown.in_fitting_unit()
        parts.append(PageTable(budget_heads(budget), budget_rows(budget), title=budget_title(budget)))
        parts.append(PageText(budget.advice()))
    if rows := _signal_rows(found.signals):
        heads = ("signal", "at", "U (95 %)", "k", "unit", "largest component")
        title = "uncertainty of signals, at the reading farthest from 0"
        parts.append(PageTable(heads, rows, title=title, numbers_from=1))
    if names := [name for name, each in found.signals.items() if not each.stated]:
        parts.append(PageText(f"uncertainty not stated: {', '.join(names)}"))
    return parts


def _signal_rows(budgets: Mapping[str, Budget]) -> list[tuple[str, ...]]:
    """Return a row for each signal whose uncertainty is stated: at its reading farthest from 0."""
    rows: list[tuple[str, ...]] = []
    for name, budget in budgets.items():
        if budget.stated:
            shown = budget.in_fitting_unit()
            value, expanded = rounded(shown.value, shown.expanded)
            rows.append((name, value, expanded, f"{shown.factor:.2f}", shown.unit, shown.rows[0].label))
    return rows


def budget_title(budget: Budget) -> str:
    """Return the value of a budget with its expanded uncertainty."""
    value, expanded = rounded(budget.value, budget.expanded)
    unit = "" if budget.unit == "1" else f" {budget.unit}"
    return (
        f"budget of {budget.signal}: ({value} ± {expanded}){unit}; 95 %, k = {budget.factor:.2f}, "
        f"ν = {_freedom(budget.freedom)}"
    )


def _freedom(freedom: float) -> str:
    return f"{freedom:.0f}" if freedom < _MANY else "∞"


def budget_heads(budget: Budget) -> tuple[str, ...]:
    """Return the heads over the rows of a budget; `part` is the sensitivity times u."""
    return ("component", "type", "u", "sensitivity", "ν", with_unit("part", budget.unit), "%")


def budget_rows(budget: Budget) -> list[tuple[str, ...]]:
    """Return the components of a budget, the largest first."""
    return [
        (
            row.label,
            f"{row.type} {row.distribution}",
            f"{row.standard:.3g} {row.unit}",
            f"{row.sensitivity:.3g}",
            _freedom(row.freedom),
            f"{row.contribution:.3g}",
            f"{100.0 * budget.share(row):.1f}",
        )
        for row in budget.rows
    ]


def _control_lines(found: ControlUncertainty) -> list[str]:
    """Return repeatability, reproducibility and accuracy of a run under control, a sentence each."""
    factor, unit = fitting_prefix(found.unit, found.accuracy, least=0.1)
    low, high = (two_digits(factor * each) for each in found.intervals["rms"])
    spread = (
        "not known, as there is one reading a target"
        if found.repeatability is None
        else f"{two_digits(factor * found.repeatability)} {unit}, standard deviation of one reading at a target "
        f"({found.freedom} degrees of freedom)"
    )
    return [
        f"repeatability: {spread}",
        "reproducibility: not known from one session; bench runs compare RUN RUN has that of two",
        f"accuracy: {two_digits(factor * found.accuracy)} {unit}, RMS of the true errors that is expected; the "
        f"readings alone say {two_digits(factor * found.rms)} {unit}; for 95 % it is between {low} and {high} {unit}",
    ]
