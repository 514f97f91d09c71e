from .evidence import Evidence as Evidence
from .hyperparameters import Learned as Learned
from .population import PopulationPrior as PopulationPrior
from .prior import Prior as Prior
from .prior_terms import Stated as Stated
