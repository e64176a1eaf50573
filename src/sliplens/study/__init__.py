"""The experiment: pick frames, explain them, score the explanations, keep what was found."""

from sliplens.study.explaining import (
    ChosenFrames,
    Explained,
    ExplainedFrame,
    Progress,
    explain_frames,
    frames_from_dataset,
    frames_from_folder,
    load_explained,
)
from sliplens.study.scoring import ScoreResult, score_explanations

__all__ = [
    "ChosenFrames",
    "Explained",
    "ExplainedFrame",
    "Progress",
    "ScoreResult",
    "explain_frames",
    "frames_from_dataset",
    "frames_from_folder",
    "load_explained",
    "score_explanations",
]
