from .hyperparameters import Learned as Learned
from .prior import Prior as Prior
from .prior_terms import ScaledPrior as ScaledPrior
