"""Light and sensors: what a raw photograph becomes at other camera settings."""

import lazy_loader

#: Version of the three packages, which are installed together.
__version__ = "0.2.0"

# A name of the stub is loaded when it is first used, so that importing is fast.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
