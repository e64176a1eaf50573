"""What a network sees: encodings of frames, torch data sets and augmentation."""

from sliplens.datasets.augmentation import Augmentation, get_augmentation
from sliplens.datasets.encodings import ENCODINGS, Encoding, get_encoding
from sliplens.datasets.frames import FrameSet, load_frames

__all__ = ["ENCODINGS", "Augmentation", "Encoding", "FrameSet", "get_augmentation", "get_encoding", "load_frames"]
