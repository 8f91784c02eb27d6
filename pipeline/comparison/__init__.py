"""Two states of the project side by side: parameters, stages, figures, and whether accuracies really differ."""

from pipeline.comparison.compare import Comparison, compare
from pipeline.comparison.words import describe

__all__ = ["Comparison", "compare", "describe"]
