"""Records of what the stages find: they return them, and a report loads them. None needs torch."""

from sliplens.results.evaluation import (
    BaselinePredictions,
    Baselines,
    BaselineScores,
    BinScore,
    Diagnosis,
    Evaluation,
    LeadTimes,
    LearningCurve,
    RegressionScores,
    Reliability,
    ScoredFrames,
    Simulation,
    SplitCount,
    Training,
    describe_simulation,
)
from sliplens.results.explanation import Explained, ExplainedFrame, load_explained
from sliplens.results.faithfulness import DeletionCurve, DeletionScores, Remedies, RemovalCurve, RemovalScores
from sliplens.results.grip import EpisodeTable, Grip, GripTrace, Hold, HoldSteps
from sliplens.results.study import Choice, MapQuality, Randomisation, States, Study, Timing, Truth

__all__ = [
    "BaselinePredictions", "BaselineScores", "Baselines", "BinScore", "Choice", "DeletionCurve", "DeletionScores",
    "Diagnosis", "EpisodeTable", "Evaluation", "Explained", "ExplainedFrame", "Grip", "GripTrace", "Hold",
    "HoldSteps", "LeadTimes", "LearningCurve", "MapQuality", "Randomisation", "RegressionScores",
    "Reliability", "Remedies", "RemovalCurve", "RemovalScores", "ScoredFrames", "Simulation", "SplitCount",
    "States", "Study", "Timing", "Training", "Truth", "describe_simulation", "load_explained",
]  # fmt: skip
