"""Recordings that cannot be written to their end, and viewers that do not start."""

import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rerun")

from bench.base import ConfigurationError
from bench.dashboard import picture, screenshot
from bench.dashboard.rerun_recording import is_whole

LIMITED = """
import resource, sys
from bench.cli import main
resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, resource.RLIM_INFINITY))
main(sys.argv[1:])
"""

DYING_VIEWER = """
import socket, sys
with socket.create_server(("127.0.0.1", int(sys.argv[1]))) as server:
    for _ in range(2):
        server.accept()[0].close()
"""


@pytest.mark.skipif(sys.platform == "win32", reason="needs limits of processes")
@pytest.mark.usefixtures("warm_popen")
def test_a_recording_that_could_not_be_written_is_said_in_a_line_and_can_be_rebuilt(tmp_path):
    # Rerun waits for its dead writer for ever, as often as not: the process has to end all the same.
    arguments = ["run", "creep", "--rig", "vo2", "--set", "duration=400", "--clock", "virtual", "--out", tmp_path]
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, *map(str, arguments)],
        capture_output=True, text=True, encoding="utf-8", timeout=120, check=False, cwd=Path(__file__).parents[2],
    )  # fmt: skip
    (run,) = tmp_path.iterdir()
    assert not is_whole(run / "run.rrd")
    said = f"the recording {run}/run.rrd is incomplete; bench runs export {run} --format rrd --out DIR rebuilds it"
    assert done.stdout.count(said) == 1
    assert "re_log_encoding" not in done.stdout + done.stderr
    assert "re_sdk" not in done.stdout + done.stderr


def test_a_file_that_is_whole(tmp_path):
    from bench.dashboard.rerun_recording import RerunRecording

    recording = RerunRecording("run", "a run", tmp_path / "run.rrd", None)
    recording.set_property("bench", {"rig": "none"})
    recording.close()
    assert is_whole(tmp_path / "run.rrd")
    content = (tmp_path / "run.rrd").read_bytes()
    (tmp_path / "run.rrd").write_bytes(content[:-40])
    assert not is_whole(tmp_path / "run.rrd")
    assert not is_whole(tmp_path / "none.rrd")


def test_a_viewer_that_listens_and_dies_needs_a_driver(monkeypatch, tmp_path):
    recording = tmp_path / "run.rrd"
    recording.touch()

    def start(options):
        port = options[options.index("--port") + 1]
        return subprocess.Popen([sys.executable, "-c", DYING_VIEWER, port])

    monkeypatch.setattr(screenshot, "start_viewer", start)
    with pytest.raises(ConfigurationError, match="it needs a Vulkan driver, such as the one of the packages"):
        picture(recording, tmp_path / "run.png")
