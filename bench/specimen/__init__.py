"""The specimen model: an emulated laboratory of the present specimen, identified from its runs."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
