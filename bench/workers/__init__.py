"""Tasks on all cores of a machine, in processes that live until the last; or one after another in this process."""

from bench.workers.pool import Pending, Workers, available_cores
from bench.workers.task import report, task_console

__all__ = ["Pending", "Workers", "available_cores", "report", "task_console"]
