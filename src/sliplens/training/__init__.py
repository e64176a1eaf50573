"""Train a network and measure how well it reads the safety margin."""

from sliplens.training.evaluate import Evaluation, RegressionScores, evaluate, regression_scores
from sliplens.training.fit import TrainConfig, TrainProgress, fit

__all__ = [
    "Evaluation",
    "RegressionScores",
    "TrainConfig",
    "TrainProgress",
    "evaluate",
    "fit",
    "regression_scores",
]
