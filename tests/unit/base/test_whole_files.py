"""Files that are never seen half written."""

import os
from pathlib import Path

import pytest

from bench.base import whole_file, write_whole


def test_a_file_that_fails_half_way_stays_as_it_was(tmp_path: Path) -> None:
    file = tmp_path / "a.json"
    write_whole(file, "before\n")
    with pytest.raises(ValueError, match="half way"), whole_file(file) as part:  # noqa: PT012
        part.write_text("half of", encoding="utf-8")
        raise ValueError("half way")
    assert file.read_text(encoding="utf-8") == "before\n"
    assert list(tmp_path.iterdir()) == [file]
    write_whole(file, "σ\n")
    assert file.read_bytes() == "σ\n".encode()


def test_what_a_link_points_to_is_written(tmp_path: Path) -> None:
    file, link = tmp_path / "a", tmp_path / "link"
    link.symlink_to(file)
    write_whole(link, "text")
    assert link.is_symlink()
    assert file.read_text(encoding="utf-8") == "text"


def test_a_pipe_is_written_itself_and_a_folder_is_refused(tmp_path: Path) -> None:
    reading, writing = os.pipe()
    pipe = Path(f"/dev/fd/{writing}")
    if pipe.exists():
        write_whole(pipe, "text")
        assert os.read(reading, 10) == b"text"
    os.close(reading)
    os.close(writing)
    with pytest.raises(OSError, match=r"."):
        write_whole(tmp_path, "text")
    assert tmp_path.is_dir()
