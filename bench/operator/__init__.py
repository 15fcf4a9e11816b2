"""Input of an operator: commands to devices, answers to questions, and letters from a panel to a run."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
