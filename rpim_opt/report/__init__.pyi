from . import plot as plot
from .page import write_checks as write_checks
from .report import write_report as write_report
