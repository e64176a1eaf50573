"""What two processes do together in `test_several_processes`; each runs this file, as torchrun would have it."""

import json
import os
import sys
from dataclasses import asdict, replace
from pathlib import Path
from unittest.mock import patch

import torch
from torch import Tensor, nn

from sliplens.errors import ModelError
from sliplens.models.encodings import ENCODINGS
from sliplens.recordings import load_dataset
from sliplens.results.evaluation import Training
from sliplens.training import TrainingConfig, fit, make_trainer
from sliplens.training.data import FrameSet, load_frames
from sliplens.training.fitting import DataOrigin

CONFIG = TrainingConfig(
    head="point", image_size=32, epochs=3, batch_size=12, augmentation="none", untouched_share=0.0, seed=5
)
ORIGIN = DataOrigin(frame_size=(48, 48), sensor="test", data_hash="none")
BAD_ROW = 7


class Plain(nn.Module):
    """A network without batch normalisation, so that an image's answer does not depend on its batch."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Conv2d(3, 8, 5, 4), nn.SiLU(), nn.Flatten(), nn.Linear(8 * 49, 1))

    def forward(self, images: Tensor) -> Tensor:
        """Predict a margin."""
        return self.layers(images)


def load(folder: Path) -> tuple[FrameSet, FrameSet]:
    """44 frames to train on, and 21 to validate on, which two processes cannot share evenly."""
    data, encoding = load_dataset(folder), ENCODINGS.pick("difference")
    train, validation = (
        load_frames(data, data.select(split=split), encoding=encoding, image_size=32)
        for split in ("train", "validation")
    )
    kept = {name: getattr(validation, name)[:21] for name in asdict(validation) if name != "encoding"}
    return train, replace(validation, **kept)


def train(folder: Path, frames: tuple[FrameSet, FrameSet], config: TrainingConfig, *, devices: int) -> Training:
    """Fit the plain network."""
    folder.mkdir(exist_ok=True, parents=True)
    trainer = make_trainer(config, accelerator="cpu", devices=devices)
    with patch("sliplens.training.fitting.build_model", lambda *_, **__: Plain()):
        return fit(config, *frames, folder, origin=ORIGIN, trainer=trainer)


def main() -> None:
    """Train as one would, until a time limit, and into a label that is no number; the first process takes notes."""
    work, data = (Path(word) for word in sys.argv[1:])
    frames = load(data)
    results = [
        train(work / "plain", frames, CONFIG, devices=2),
        train(work / "timed", frames, replace(CONFIG, epochs=100_000, max_minutes=0.02), devices=2),
    ]
    labels = frames[0].safety_margin.clone()
    labels[BAD_ROW] = torch.nan
    try:
        results.append(train(work / "bad", (replace(frames[0], safety_margin=labels), frames[1]), CONFIG, devices=2))
    except ModelError as error:
        if os.environ["RANK"] == "0":
            stops = [training.stopped_by for training in results]
            (work / "notes.json").write_text(json.dumps({"stops": stops, "error": str(error)}))
    else:
        raise AssertionError("the label that is no number was trained on")


if __name__ == "__main__":
    main()
