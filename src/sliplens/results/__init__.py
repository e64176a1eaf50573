"""Records of what the stages find: they return them, and a report loads them. None needs torch."""

from sliplens.results.diagnosis import Diagnosis
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
from sliplens.results.explanation import Explained, ExplainedFrame, load_explained
from sliplens.results.faithfulness import DeletionCurve, DeletionScores, Remedies, RemovalCurve, RemovalScores
from sliplens.results.grip import EpisodeTable, Grip, GripTrace
from sliplens.results.study import Choice, MapQuality, PooledScores, Randomisation, States, Study, Timing, Truth
from sliplens.results.training import LearningCurve, Simulation, SplitCount, Training, describe_simulation

__all__ = [
    "BaselinePredictions", "BaselineScores", "Baselines", "BinScore", "Choice", "DeletionCurve", "DeletionScores",
    "Diagnosis", "EpisodeTable", "Evaluation", "Explained", "ExplainedFrame", "Grip", "GripTrace", "LeadTimes",
    "LearningCurve", "MapQuality",
    "PooledScores", "Predictions", "Randomisation", "RegressionScores", "Reliability", "Remedies", "RemovalCurve",
    "RemovalScores", "Simulation", "SplitCount", "States", "Study", "Timing", "Training", "Truth",
    "describe_simulation", "load_explained",
]  # fmt: skip
