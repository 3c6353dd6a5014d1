"""Exposure policies, from a spot meter to PPO, and the evaluation that compares them."""

import lazy_loader

# A name of the stub is loaded when it is first used.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
