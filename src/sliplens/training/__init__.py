"""Train a network and measure how well it predicts the safety margin."""

from sliplens.training.config import RECIPES, TrainingConfig
from sliplens.training.evaluation import evaluate, evaluate_frames, lead_times, regression_scores
from sliplens.training.fitting import fit, train
from sliplens.training.module import make_trainer

__all__ = [
    "RECIPES", "TrainingConfig", "evaluate", "evaluate_frames", "fit", "lead_times", "make_trainer",
    "regression_scores", "train",
]  # fmt: skip
