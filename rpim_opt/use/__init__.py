"""Uses of a calibrated robot: compensation, validation, recalibration, monitoring, export."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
