"""A script with two worker processes whose tasks wait for ever."""

import sys

import worker_tasks

from bench.base import Workers

with Workers(2) as workers:
    for _ in range(2):
        workers.submit("wait", worker_tasks.wait, sys.argv[1])
