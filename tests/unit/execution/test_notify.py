import json
import socketserver
import sys
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest
from heater_protocols import stairs
from rich.console import Console

from bench.base import ConfigurationError
from bench.execution import Run, carry_out
from bench.execution.notify import Notifier, sender
from bench.record import Event, Record

FACTS = {
    "event": "trip",
    "text": "too hot",
    "rig": "heater",
    "protocol": "stairs",
    "values": {"tec_temperature": 90.0},
}


@pytest.fixture
def listener(tmp_path):
    """A program that writes down what it is told, a line each time; its command, and what it has written."""
    out = tmp_path / "told.jsonl"
    program = tmp_path / "listen.py"
    program.write_text(
        "import json, os, sys\n"
        "facts = json.loads(sys.stdin.buffer.read())\n"
        f"with open({str(out)!r}, 'a') as file:\n"
        "    file.write(json.dumps([os.environ['BENCH_EVENT'], os.environ['BENCH_TEXT'], facts]) + '\\n')\n"
    )

    def told():
        return [json.loads(line) for line in out.read_text().splitlines()] if out.exists() else []

    return f'"{sys.executable}" "{program}"', told


class TestTargets:
    @pytest.mark.parametrize(
        ("target", "message"),
        [
            ("no-such-program-here", "there is no such program"),
            ("", "there is no such program"),
            ('say "hello', "there is no such program"),
            ("https://", "there is no such program"),
            ("mailto:nobody", "expected mailto:NAME@DOMAIN"),
            ("mailto:me@lab.example", "BENCH_SMTP_HOST is not set"),
        ],
    )
    def test_refuses(self, monkeypatch, target, message):
        monkeypatch.delenv("BENCH_SMTP_HOST", raising=False)
        with pytest.raises(ConfigurationError, match=message):
            Notifier([target])

    def test_refuses_a_mail_server_without_a_number_as_its_port(self, monkeypatch):
        monkeypatch.setenv("BENCH_SMTP_HOST", "mail.lab.example")
        monkeypatch.setenv("BENCH_SMTP_PORT", "smtp")
        with pytest.raises(ConfigurationError, match="BENCH_SMTP_PORT is 'smtp'; expected a number"):
            Notifier(["mailto:me@lab.example"])

    def test_a_command_gets_the_facts_twice(self, listener):
        command, told = listener
        sender(command)(FACTS)
        assert told() == [["trip", "too hot", FACTS]]

    def test_a_command_that_fails_says_why(self):
        with pytest.raises(OSError, match="exit code 3: no paper"):
            sender(f'"{sys.executable}" -c "import sys; print(\'no paper\', file=sys.stderr); sys.exit(3)"')(FACTS)

    def test_a_webhook_gets_json(self):
        bodies = []

        class Hook(BaseHTTPRequestHandler):
            def do_POST(self):
                bodies.append((self.headers["Content-Type"], self.rfile.read(int(self.headers["Content-Length"]))))
                self.send_response(204)
                self.end_headers()

            def log_message(self, *_):
                pass

        with HTTPServer(("127.0.0.1", 0), Hook) as server:
            thread = threading.Thread(target=server.handle_request)
            thread.start()
            sender(f"http://127.0.0.1:{server.server_port}/hook")(FACTS)
            thread.join(30)
        ((kind, body),) = bodies
        assert kind == "application/json"
        assert json.loads(body) == FACTS

    def test_mail(self, monkeypatch):
        lines = []

        class Mail(socketserver.StreamRequestHandler):
            def handle(self):
                self.wfile.write(b"220 here\r\n")
                in_text = False
                for line in self.rfile:
                    lines.append(line.decode().rstrip("\r\n"))
                    word = line[:4].upper()
                    if in_text:
                        in_text = line != b".\r\n"
                        self.wfile.write(b"" if in_text else b"250 taken\r\n")
                    elif word == b"DATA":
                        in_text = True
                        self.wfile.write(b"354 go on\r\n")
                    else:
                        self.wfile.write(b"221 bye\r\n" if word == b"QUIT" else b"250 fine\r\n")

        with socketserver.TCPServer(("127.0.0.1", 0), Mail) as server:
            thread = threading.Thread(target=server.handle_request)
            thread.start()
            monkeypatch.setenv("BENCH_SMTP_HOST", "127.0.0.1")
            monkeypatch.setenv("BENCH_SMTP_PORT", str(server.server_address[1]))
            monkeypatch.setenv("BENCH_SMTP_TLS", "no")
            sender("mailto:operator@lab.example")({**FACTS, "rig": "heater\r\nBcc: other@lab.example"})
            thread.join(30)
        assert "rcpt TO:<operator@lab.example>" in lines
        assert "Subject: [bench] trip: stairs on heater Bcc: other@lab.example" in lines
        assert sum(line.lower().startswith("rcpt") for line in lines) == 1
        assert "too hot" in lines


class TestSecrets:
    TOKEN = "T0K3N"

    @pytest.mark.parametrize("equals", [False, True])
    def test_neither_a_record_nor_what_is_made_of_it_holds_them(self, bench, tmp_path, monkeypatch, equals):
        program = (
            f'"{sys.executable}" -c "import sys; sys.stdin.read(); sys.exit({int(equals)})" --token {self.TOKEN}'
        )
        targets = [program, f"http://me:{self.TOKEN}@127.0.0.1:1/hooks/{self.TOKEN}?key={self.TOKEN}"]
        options = [f"--notify={target}" for target in targets]
        if not equals:
            options = [word for target in targets for word in ("--notify", target)]
        command = ["run", "creep", "--rig", "vo2", "--clock", "virtual", "--set", "duration=4", "--set", "settling=2",
                   "--out", tmp_path / "runs", *options]  # fmt: skip
        monkeypatch.setattr(sys, "argv", ["bench", *map(str, command)])
        code, out, err = bench(*command)
        assert code == 0
        assert "was not told of the end" in out + err
        (run,) = (tmp_path / "runs").iterdir()
        # What is made of a record does not depend on how its command was written.
        for kind in () if equals else ("csv", "bluesky"):
            assert bench("runs", "export", run, "--format", kind, "--out", tmp_path / kind)[0] == 0
        assert equals or bench("report", run)[0] == 0
        with Record(run) as record:
            assert record.meta["command"][-1].endswith("://127.0.0.1/…")
        texts = [out, err, *(path.read_bytes().decode(errors="replace") for path in tmp_path.rglob("*.*"))]
        assert not [text for text in texts if self.TOKEN in text]


class TestNotifier:
    def test_what_is_told_and_what_is_not(self, listener):
        command, told = listener
        with Notifier([command]) as notifier:
            notifier.signals = ("tec_temperature",)
            notifier.facts = {"rig": "heater"}
            notifier.telemetry(1.0, 0, (40.0,))
            for level, kind in (
                ("INFO", "phase"), ("WARN", "pause"), ("INFO", "resume"), ("INFO", "prompt"), ("WARN", "warning"),
                ("INFO", "warning"), ("WARN", "interlock"), ("ERROR", "interlock"), ("WARN", "end"),
            ):  # fmt: skip
                notifier.event(Event(2.0, level, kind, f"{level} {kind}"))
        assert [event for event, *_ in told()] == ["pause", "prompt", "warning", "warning", "trip", "end"]
        *_, (_, text, facts) = told()
        assert text == "WARN end: ERROR interlock"
        assert facts["values"] == {"tec_temperature": 40.0}
        assert (facts["rig"], facts["t"]) == ("heater", 2.0)
        assert not notifier.take_notices()

    def test_a_failure_that_another_process_has_told_is_not_told_again(self, listener):
        command, told = listener
        with Notifier([command]) as notifier:
            notifier.is_told = lambda: True
            notifier.event(Event(0.0, "WARN", "pause", "paused"))
            notifier.event(Event(1.0, "WARN", "end", "failed"))
            notifier.event(Event(2.0, "INFO", "end", "completed"))
        assert [text for _, text, _ in told()] == ["paused", "completed"]

    def test_what_fails_is_said_and_the_next_is_told(self, listener):
        command, told = listener
        failing = f'"{sys.executable}" -c "raise SystemExit(1)"'
        with Notifier([failing, command]) as notifier:
            notifier.event(Event(0.0, "WARN", "pause", "paused"))
        assert len(told()) == 1
        (notice,) = notifier.take_notices()
        assert notice == f'"{sys.executable}" … was not told of the pause: exit code 1'

    def test_nothing_waits_for_one_that_hangs(self, monkeypatch):
        free = threading.Event()
        monkeypatch.setattr("bench.execution.notify.sender", lambda _: lambda _: free.wait(60))
        with Notifier(["slow"]) as notifier:
            for _ in range(40):
                notifier.event(Event(0.0, "WARN", "pause", "paused"))
            notices = notifier.take_notices()
            free.set()
        # 20 wait, and one is under way at most.
        assert 19 <= len(notices) <= 20
        assert "20 messages wait already" in notices[0]

    def test_one_that_hangs_keeps_no_other_from_being_told(self, monkeypatch):
        free, told = threading.Event(), threading.Event()
        senders = {"slow": lambda _: free.wait(), "quick": lambda _: told.set()}
        monkeypatch.setattr("bench.execution.notify.sender", senders.__getitem__)
        with Notifier(["slow", "quick"]) as notifier:
            notifier.event(Event(0.0, "WARN", "pause", "paused"))
            was_told = told.wait(30)
            free.set()
        assert was_told

    def test_a_run_tells_its_end_and_records_what_failed(self, listener, tmp_path, rig_file):
        command, told = listener
        failing = f'"{sys.executable}" -c "raise SystemExit(1)"'
        run = Run(
            protocol=stairs, settings={}, rig=rig_file(), folder=tmp_path / "runs", clock="virtual", recording=False,
            notify=(command, failing),
        )  # fmt: skip
        result = carry_out(run, Console(quiet=True))
        ((event, text, facts),) = told()
        assert (event, text) == ("end", "completed")
        assert facts["run"] == str(result.folder.resolve())
        assert facts["values"]["tec_temperature"] > 30.0
        with Record(result.folder) as record:
            assert [each.text for each in record.events() if each.kind == "notify"] == [
                f'"{sys.executable}" … was not told of the end: exit code 1'
            ]
            assert record.status == "completed"
