"""The guardian's own record: what it saw and did, also after the bench is gone."""

from __future__ import annotations

import os
import queue
import threading
from collections import deque
from pathlib import Path
from typing import Any

from bench.base import json_text, wall_time
from bench.record import BEGIN, BLACK_BOX_NAME

_KEPT = 150
"""Looks that are kept for the record of what went before a trip: 30 s at 5 Hz."""


class BlackBox:
    """Lines of JSON, written to the disk by a thread: a disk that is full or slow delays nothing."""

    def __init__(self) -> None:
        self._looks: deque[dict[str, Any]] = deque(maxlen=_KEPT)
        self._queue: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._path: Path | None = None
        self._thread = threading.Thread(target=self._write, name="black box", daemon=True)
        self._thread.start()

    def keep_in(self, folder: Path, **content: Any) -> None:  # noqa: ANN401 - anything that JSON can hold
        """Write to the folder of a run from now on, first what begins; looks before that come with the next note."""
        self._path = folder / BLACK_BOX_NAME
        self._write_down(BEGIN, content)

    def saw(self, values: dict[str, float]) -> None:
        """Note a look; it is written only if something happens within the next half a minute."""
        self._looks.append({"at": wall_time().isoformat(), "values": values})

    def note(self, what: str, **content: Any) -> None:  # noqa: ANN401 - anything that JSON can hold
        """Write down that something happened, and the looks before it."""
        while self._looks:
            self._queue.put(json_text({"what": "look", **self._looks.popleft()}))
        self._write_down(what, content)

    def _write_down(self, what: str, content: dict[str, Any]) -> None:
        self._queue.put(json_text({"what": what, "at": wall_time().isoformat(), **content}))

    def close(self) -> None:
        """Write what is left, for a second at most."""
        self._queue.put(None)
        self._thread.join(1.0)

    def _write(self) -> None:
        pending: list[str] = []
        ending = False
        while not ending:
            line = self._queue.get()
            ending = line is None
            if line is not None:
                pending.append(line)
            if self._path is None or not (ending or self._queue.empty()):
                continue
            try:
                with self._path.open("a", encoding="utf-8") as file:
                    file.writelines(f"{each}\n" for each in pending)
                    file.flush()
                    os.fsync(file.fileno())
            # It must not hinder the safe state; what cannot be written is lost.
            except OSError:
                pass
            pending.clear()
