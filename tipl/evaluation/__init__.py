"""Judges forecasters on runs that they have not seen."""

from tipl.evaluation.config import EvaluateConfig
from tipl.evaluation.evaluate import evaluate

__all__ = ["EvaluateConfig", "evaluate"]
