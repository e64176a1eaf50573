"""A network that sees the untouched sensor beside the frame."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import sliplens as sl
from sliplens.errors import InputError
from sliplens.models import Network, build_model, load, save_checkpoint
from sliplens.recordings import Dataset, Recording


def begun(folder: Path) -> Network:
    """A pair network that begins with the weights of another."""
    other = load(folder)
    model = build_model(head=other.manifest.head, colours=6)
    weights = other.model.state_dict()
    first = next(name for name, value in weights.items() if value.ndim == 4)
    weights[first] = torch.cat([weights[first], torch.zeros_like(weights[first])], dim=1)
    model.load_state_dict(weights)
    return Network(model=model.eval(), manifest=replace(other.manifest, input="pair"))


@pytest.fixture
def touch(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Frames and their reference; each frame has a pixel that is white, so that its own maximum is the whole range."""
    frames = recording.frames.copy()
    frames[:, 0, 0] = 255
    return frames, recording.reference


def test_without_weight_on_the_reference_it_answers_as_a_raw_network(raw_run: Path, touch: tuple[np.ndarray, ...]):
    frames, reference = touch
    # at full size, where a white pixel stays white
    raw, pair = (replace(run, manifest=replace(run.manifest, image_size=48)) for run in (load(raw_run), begun(raw_run)))
    torch.testing.assert_close(
        pair.predict(pair.encode(frames, reference)), raw.predict(raw.encode(frames, reference)), atol=1e-5, rtol=0
    )
    other = 255 - reference
    assert torch.equal(pair.predict(pair.encode(frames, other)), pair.predict(pair.encode(frames, reference)))


def test_it_does_without_no_reference(raw_run: Path, recording: Recording):
    with pytest.raises(InputError, match="name its image with --reference IMAGE"):
        sl.predict(begun(raw_run), recording.frames)
    with pytest.raises(InputError, match="sees the untouched sensor beside the frame"):
        begun(raw_run).encode(recording.frames, None)


def test_from_training_to_an_explanation(small_dataset: Dataset, tmp_path: Path):
    run = sl.train(small_dataset, input="pair", image_size=32, epochs=1, batch_size=11)
    save_checkpoint(tmp_path, run.model, run.manifest)
    again = load(tmp_path)
    assert (again.manifest.input, again.encoding.colours) == ("pair", 6)
    found = sl.evaluate(again, small_dataset)
    recording = small_dataset.load(small_dataset.select(split="test")[0])
    frames, reference = recording.frames[1:3], recording.reference
    rows = sl.predict(again, frames, reference=reference).to_arrow().to_pydict()["prediction"]
    tested = found.predictions
    own = tested.prediction[tested.trial == recording.trial][:2]
    np.testing.assert_allclose(rows, own, atol=1e-5)
    explanation = sl.explain(again, frames, reference=reference, method="occlusion")
    np.testing.assert_allclose([frame.prediction for frame in explanation.frames], own, atol=1e-5)
    # the untouched sensor, twice
    empty = again.predict(again.encode(reference[None], reference))
    untouched = [frame.reference_prediction for frame in explanation.frames]
    np.testing.assert_allclose(untouched, empty.expand(2).numpy(), atol=1e-5)
