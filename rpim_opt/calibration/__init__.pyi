from . import baselines as baselines
from .certificate import Certificate as Certificate
from .loop import calibrate as calibrate
from .outcome import Iteration as Iteration
from .outcome import Prediction as Prediction
from .result import Calibration as Calibration
from .uncertainty import Uncertainty as Uncertainty
from .uncertainty import monte_carlo as monte_carlo
