"""Models for other controllers: as C99, and as functional mock-up units."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
