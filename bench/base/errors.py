"""The exceptions of the bench, one small family.

Each message says which device, file or parameter is meant, what was found, and what to do or what is
allowed. The command line prints the message alone; a traceback is for defects of the bench itself.
"""

from __future__ import annotations

from typing import Any


class BenchError(Exception):
    """Base of everything that the bench raises on purpose.

    Attributes
    ----------
    exit_code : int
        What the `bench` command exits with when this error ends it.
    """

    exit_code = 1

    def __reduce__(self) -> tuple[Any, ...]:
        # By its content, as a constructor may take something else: errors travel between processes.
        return _restored, (type(self), self.args, self.__dict__)


def _restored(kind: type[BenchError], arguments: tuple[object, ...], attributes: dict[str, object]) -> BenchError:
    error = kind.__new__(kind, *arguments)
    error.__dict__.update(attributes)
    return error


class ConfigurationError(BenchError):
    """A rig file, a parameter or a command is wrong; nothing has moved yet."""

    exit_code = 2


class DataError(BenchError):
    """A file of measurements, a model file or a journal cannot be used as it is."""

    exit_code = 3


class DeviceError(BenchError):
    """An instrument answered with an error, or in a way that its protocol does not allow.

    Parameters
    ----------
    device : str
        Name of the device in the rig.
    message : str
        What happened and what to do about it.

    Attributes
    ----------
    device : str
        Name of the device in the rig.
    text : str
        The message, without the name.
    """

    exit_code = 4

    def __init__(self, device: str, message: str) -> None:
        super().__init__(f"{device}: {message}")
        self.device, self.text = device, message


class DeviceConnectionError(DeviceError):
    """An instrument cannot be reached, or stopped answering."""


class DeviceRestartedError(DeviceError):
    """An instrument has restarted since it was connected: its settings are lost, and it has to be connected again."""


class WatchdogError(DeviceError):
    """An instrument is in error as its watchdog has expired: its host was silent, and its output went off."""


class LimitError(DeviceError):
    """A set-point lies outside of the limits of the device; it was not sent."""


class InterlockError(BenchError):
    """A watched signal left its allowed range and the run was ended in the safe state."""

    exit_code = 5


class SettleTimeoutError(BenchError):
    """A signal did not become steady within the time that the step allows."""

    exit_code = 6


class GuardianError(BenchError):
    """The process that holds the lines of the instruments was lost, or ended the run as its bench did not answer."""

    exit_code = 7


class RecordError(BenchError):
    """The journal of a run is damaged, or rows are missing in it; `bench runs repair` says how far it is good."""

    exit_code = 8


class IncompleteRecordWarning(UserWarning):
    """A record lacks rows that were recorded. The command line prints it; a program gets it by `warnings`."""


class AgreementError(BenchError):
    """A resumed run did not find the specimen as its record left it; it was ended in the safe state."""

    exit_code = 9


class ConvergenceError(BenchError):
    """A controller drove its actuator to and fro without end, or past its target; the run ended in the safe state."""

    exit_code = 10


class AbortError(BenchError):
    """The operator, or the operating system, ended the run; the safe state was reached."""

    exit_code = 130
