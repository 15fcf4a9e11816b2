"""`bench`, and `python -m bench`: the command line, which Ctrl-C ends without a traceback while it loads, too."""

from __future__ import annotations

import sys
import warnings
from typing import NoReturn


def start() -> NoReturn:
    """Run the command of the command line."""
    if not sys.warnoptions:
        # Libraries warn with lines of their sources; what a user can act on is said by the bench. Worker processes
        # get the same.
        sys.warnoptions.append("ignore")
        warnings.simplefilter("ignore")
    try:
        # Loading it takes a while.
        from bench.cli import main

        main()
    except KeyboardInterrupt:
        sys.stderr.write("ended by Ctrl-C: no device was opened, nothing has moved\n")
        sys.exit(130)


if __name__ == "__main__":
    start()
