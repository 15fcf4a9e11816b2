"""A bench that switches an output on, and leaves a child, whose number it prints, and is killed.

With `stop`, it prints the number of its guardian and waits.

    python fork_and_die.py ENDPOINTS [stop]
"""

import os
import signal
import sys
import time
from pathlib import Path

from bench.execution.guardian.remote import RemoteStation
from bench.rig import attach, load_rig

endpoints = Path(sys.argv[1])
station = RemoteStation(attach(endpoints, "vo2").clock, load_rig("vo2"), "vo2", {}, endpoints, 0, "a test")
station.promise(600.0, "a child lives on")
station.apply({"tec": 40.0})
if sys.argv[2:]:
    print(station._process.pid, flush=True)
    time.sleep(600.0)
child = os.fork()
if child == 0:
    time.sleep(600.0)
    os._exit(0)
print(child, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
