"""Analysis of data: tables from files, models from tables, comparisons, figures, reports and exports."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
