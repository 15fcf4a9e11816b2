"""How late the samples of a loop were: a histogram, as it is kept with a run."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from bench.base import counted

EDGES = (1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2, 2e-2, 5e-2, 0.1, 0.2, 0.5, 1.0)
"""Upper ends of all bins but the last, which has none, s; each belongs to its bin."""

_BAR = 40


@dataclass
class Lateness:
    """How late the samples of one kind of loop were, against the instants at which they were due.

    Attributes
    ----------
    rate : float or None
        Samples in a second that were asked for, Hz; None where a controller says when it wants the next one.
    left_out : int
        Samples that were not taken, as the next one was due already.
    counts : list of int
        Samples by bin; the bins end at `EDGES`.
    total, worst : float
        Sum and largest of all lateness, s.
    """

    rate: float | None
    left_out: int = 0
    counts: list[int] = field(default_factory=lambda: [0] * (len(EDGES) + 1))
    total: float = 0.0
    worst: float = 0.0

    def add(self, late: float, count: int = 1) -> None:
        """Add samples that were so late, s; one that is early is not late."""
        if late > 0.0:
            self.counts[bisect_left(EDGES, late)] += count
            self.total += count * late
            self.worst = max(self.worst, late)
        else:
            self.counts[0] += count

    def merge(self, other: Lateness) -> None:
        """Add those of another loop of the same kind."""
        self.left_out += other.left_out
        self.counts = [ours + theirs for ours, theirs in zip(self.counts, other.counts, strict=True)]
        self.total += other.total
        self.worst = max(self.worst, other.worst)

    @property
    def samples(self) -> int:
        """Number of samples that were taken."""
        return sum(self.counts)

    def to_json(self) -> dict[str, Any]:
        """Return it as metadata: times in s, the last bin without an end."""
        samples = self.samples
        return {
            "rate": self.rate,
            "samples": samples,
            "left_out": self.left_out,
            "mean": self.total / samples if samples else 0.0,
            "worst": self.worst,
            "edges": list(EDGES),
            "counts": list(self.counts),
        }


def headline_of(label: str, recorded: Mapping[str, Any]) -> str:
    """Return a histogram in one line, see `Lateness.to_json`, behind the label of its loop."""
    rate = f" at {recorded['rate']:g} Hz" if recorded["rate"] is not None else ""
    return (
        f"{label or 'the loop'}: {counted(recorded['samples'], 'sample')}{rate}, {recorded['left_out']} left out; "
        f"mean {1e3 * recorded['mean']:.3g} ms, worst {1e3 * recorded['worst']:.3g} ms"
    )


def bins_of(recorded: Mapping[str, Any]) -> list[tuple[str, int]]:
    """Return the bins of a histogram, see `Lateness.to_json`, up to the last that is not empty: name and count."""
    names = [f"≤ {1e3 * edge:g} ms" for edge in recorded["edges"]] + [f"> {1e3 * recorded['edges'][-1]:g} ms"]
    last = max((i for i, count in enumerate(recorded["counts"]) if count), default=0)
    return list(zip(names[: last + 1], recorded["counts"], strict=False))


def lateness_lines(recorded: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """Yield the histograms of a run as text, by the label of the loop; see `Lateness.to_json`."""
    for label, each in recorded.items():
        yield f"lateness of {headline_of(label, each)}"
        most = max(each["counts"])
        for name, count in bins_of(each):
            yield f"  {name:>10} {count:>9}  {'█' * round(_BAR * count / most) if most else ''}".rstrip()
