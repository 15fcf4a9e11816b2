"""A run from its start to the safe state.

`carry_out` plans, rehearses, connects, carries out and closes a run. The engine sends the messages of the protocol to
a station: the rig in this process, or in a guardian process that keeps real instruments safe if the bench dies.
Rehearsing, resuming and repeating a run are here as well.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
