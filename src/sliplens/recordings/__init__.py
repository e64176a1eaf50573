"""Recordings: trials of a tactile sensor with forces and slip labels, in memory and on disk."""

from sliplens.recordings.dataset import Dataset, TrialInfo
from sliplens.recordings.trial import ContactState, GroundTruth, Recording

__all__ = ["ContactState", "Dataset", "GroundTruth", "Recording", "TrialInfo"]
