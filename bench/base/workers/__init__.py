"""Tasks on all cores of a machine, in processes that live until the last; or one after another in this process."""

from bench.base.workers.pool import Pending, Workers, available_cores
from bench.base.workers.task import report, task_console

__all__ = ["Pending", "Workers", "available_cores", "report", "task_console"]
