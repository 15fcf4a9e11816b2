"""Commands in this process; Hypothesis without deadlines, as the first call of a compiled loop loads it."""

import pytest
from hypothesis import settings

from bench.cli import main

settings.register_profile("compiled", deadline=None)
settings.load_profile("compiled")


@pytest.fixture
def bench(capsys):
    """Run a command in this process; return exit code, standard output and standard error."""

    def run(*arguments):
        with pytest.raises(SystemExit) as stopped:
            main([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        return stopped.value.code or 0, captured.out, captured.err

    return run
