"""The panel: a rig under the operator's hands, or a run in progress, in the terminal."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
