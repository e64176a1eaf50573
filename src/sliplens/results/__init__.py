"""Records of what the stages find: they return them, and a report loads them. None needs torch."""

from sliplens.results.evaluation import (
    BaselinePredictions,
    Baselines,
    BaselineScores,
    BinScore,
    Evaluation,
    LeadTimes,
    Predictions,
    RegressionScores,
    Reliability,
)
from sliplens.results.simulation import Simulation, SplitCount, describe_simulation
from sliplens.results.training import LearningCurve, Training

__all__ = [
    "BaselinePredictions",
    "BaselineScores",
    "Baselines",
    "BinScore",
    "Evaluation",
    "LeadTimes",
    "LearningCurve",
    "Predictions",
    "RegressionScores",
    "Reliability",
    "Simulation",
    "SplitCount",
    "Training",
    "describe_simulation",
]
