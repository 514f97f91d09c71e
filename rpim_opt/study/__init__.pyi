from .arms import SimulatedArm as SimulatedArm
from .arms import simulated_arm as simulated_arm
from .report import Metric as Metric
from .report import Report as Report
