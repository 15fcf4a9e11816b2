"""Protocols: generators that yield messages, such as `Step`, and receive readings.

The vocabulary of messages, the parameters of protocols, their plan before anything moves, and their discovery.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
