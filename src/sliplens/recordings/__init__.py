"""Recordings: trials of a tactile sensor with forces and slip labels, in memory and on disk."""

from sliplens.recordings.dataset import Dataset, TrialInfo
from sliplens.recordings.recording import ContactState, Recording
from sliplens.recordings.truth import GroundTruth

__all__ = ["ContactState", "Dataset", "GroundTruth", "Recording", "TrialInfo"]
