"""The experiment: pick frames, explain them, score the explanations, keep what was found."""

from sliplens.study.explaining import ChosenFrames, explain_frames, frames_from_dataset, frames_from_folder
from sliplens.study.run import run_study
from sliplens.study.workspace import explain_source, explain_trial, score_explained

__all__ = [
    "ChosenFrames", "explain_frames", "explain_source", "explain_trial", "frames_from_dataset", "frames_from_folder",
    "run_study", "score_explained",
]  # fmt: skip
