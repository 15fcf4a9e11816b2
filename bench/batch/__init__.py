"""Many runs: the studies of `bench study`, campaigns over rigs and seeds, and the tuning of controllers."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
