from .report import Metric as Metric
from .report import Report as Report
