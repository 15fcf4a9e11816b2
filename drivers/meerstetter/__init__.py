"""Meerstetter TEC controllers on a serial line, by the MeCom protocol."""

from drivers.meerstetter.device_errors import DEVICE_ERRORS
from drivers.meerstetter.mecom import SERVER_ERRORS
from drivers.meerstetter.tec import MeerstetterTEC

__all__ = ["DEVICE_ERRORS", "SERVER_ERRORS", "MeerstetterTEC"]
