"""One HTML page about a dataset: which agent parameters it asks for and why, plots, and every check."""

from sb3_dce.report.advice import Advice, advise
from sb3_dce.report.behaviour import Behaviour, estimate_behaviour
from sb3_dce.report.page import write_report

__all__ = ["Advice", "Behaviour", "advise", "estimate_behaviour", "write_report"]
