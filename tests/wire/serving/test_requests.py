"""Lines that are no requests of the control socket."""

import pytest
from cases import cases

from bench.base import ConfigurationError
from sim_devices.serving.requests import parse_request


@cases("line", [b'{"do":' * 100_000, b"[" * 100_000, b"\xff\xfe\x00", b"GET / HTTP/1.1", b"\x00" * 10])
def test_what_is_no_json_is_refused(line):
    with pytest.raises(ConfigurationError, match="not a line of JSON"):
        parse_request(line)
