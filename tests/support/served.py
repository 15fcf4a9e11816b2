"""What the clients of served instruments share."""

import re

PATIENCE = 60.0
"""Wall-clock time that a busy machine may take for anything, s."""


def address(url):
    """Return host and port of `tcp://HOST:PORT`."""
    host, port = re.fullmatch(r"tcp://(.+):(\d+)", url).groups()
    return host, int(port)
