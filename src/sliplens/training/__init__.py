"""Train a network and measure how well it reads the safety margin."""

from sliplens.training.config import RECIPES, TrainConfig, get_recipe
from sliplens.training.evaluate import Evaluation, RegressionScores, evaluate, regression_scores
from sliplens.training.fit import TrainProgress, fit
from sliplens.training.hardware import Hardware

__all__ = [
    "RECIPES",
    "Evaluation",
    "Hardware",
    "RegressionScores",
    "TrainConfig",
    "TrainProgress",
    "evaluate",
    "fit",
    "get_recipe",
    "regression_scores",
]
