from .prior import Prior as Prior
from .prior_terms import ScaledPrior as ScaledPrior
