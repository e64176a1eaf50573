from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sliplens.errors import InputError, ModelError
from sliplens.models import Manifest, Network, load, save_checkpoint
from sliplens.models.encodings import ENCODINGS
from sliplens.progress import OnProgress, reporting
from sliplens.recordings import Dataset
from sliplens.results.evaluation import Training
from sliplens.training import RECIPES, TrainingConfig, evaluate_frames, fit, fitting
from sliplens.training.data import FrameSet, load_frames
from sliplens.training.module import WholeCheckpoints

CONFIG = TrainingConfig(image_size=32, epochs=3, batch_size=11, seed=3)


@pytest.fixture(scope="module")
def frames(small_dataset: Dataset) -> tuple[FrameSet, FrameSet]:
    encoding = ENCODINGS["difference"]
    train, validation = (
        load_frames(small_dataset, small_dataset.select(split=split), encoding=encoding, image_size=32)
        for split in ("train", "validation")
    )
    return train, validation


def run(
    folder: Path,
    frames: tuple[FrameSet, FrameSet],
    config: TrainingConfig = CONFIG,
    *,
    start: Network | None = None,
    on_progress: OnProgress | None = None,
) -> Training:
    folder.mkdir(exist_ok=True)
    with reporting(on_progress):
        manifest = Manifest(
            backbone=config.backbone, head=config.head, input="difference", image_size=config.image_size,
            frame_size=(48, 48), sensor="test", data_hash="none", trained_on=("abc",),
        )  # fmt: skip
        return fit(config, *frames, folder, manifest, start=start)


@pytest.fixture(scope="module")
def trained_run(tmp_path_factory: pytest.TempPathFactory, frames: tuple[FrameSet, FrameSet]) -> Path:
    folder = tmp_path_factory.mktemp("run")
    run(folder, frames)
    return folder


def test_a_network_learns(tmp_path: Path, frames: tuple[FrameSet, FrameSet]):
    result = run(tmp_path / "run", frames, replace(CONFIG, epochs=25))
    # labels are spread evenly over [0, 1): their variance, the error of the best constant, is 0.08
    assert result.best_validation_mse < 0.03
    scores = evaluate_frames(load(tmp_path / "run"), frames[1]).conditions["dry"]
    assert scores.mse == pytest.approx(result.best_validation_mse, abs=1e-5)  # the best weights were kept


@pytest.mark.parametrize("where", ["in the last epoch", "after it"])
def test_epochs_without_gain_are_not_trained_again(
    where: str, tmp_path: Path, frames: tuple[FrameSet, FrameSet], monkeypatch: pytest.MonkeyPatch
):
    """Labels to validate by that are the opposite of those to learn: after the first epochs nothing is gained."""
    train, validation = frames
    turned = train, replace(validation, safety_margin=1 - validation.safety_margin)
    patient = replace(CONFIG, epochs=40, patience=3, learning_rate=1e-3)
    whole = run(tmp_path / "whole", turned, patient)
    assert whole.stopped_by == "no gain"
    steps, done = 4 * round(whole.epochs), []  # 4 batches of 11 are an epoch

    def count(step: int, _: int) -> None:
        done.append(step)
        if where == "in the last epoch" and len(done) == steps - 2:
            raise KeyboardInterrupt

    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        if where == "after it":
            patch.setattr(fitting, "calibrate", interrupt)
        with pytest.raises(KeyboardInterrupt):
            run(tmp_path / "cut", turned, patient, on_progress=count)
    again = run(tmp_path / "cut", turned, patient, on_progress=count)
    # the two steps of the epoch that was cut come again, and nothing else
    assert len(done) == steps + (2 if where == "in the last epoch" else 0)
    assert (again.epochs, again.stopped_by) == (whole.epochs, "no gain")
    first, second = ((tmp_path / name / "model.safetensors").read_bytes() for name in ("whole", "cut"))
    assert first == second
    assert not (tmp_path / "cut" / "checkpoints").exists()


def test_a_disk_that_fills_leaves_the_last_checkpoint(tmp_path: Path):
    resource = pytest.importorskip("resource")
    path, writer = tmp_path / "last.ckpt", WholeCheckpoints()
    writer.save_checkpoint({"weights": torch.zeros(8)}, path)
    before, limits = path.read_bytes(), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2 * len(before), limits[1]))
    try:
        with pytest.raises(InputError, match="make room"):
            writer.save_checkpoint({"weights": torch.zeros(100_000)}, path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_training_leaves_the_callers_random_state_alone(tmp_path: Path, frames: tuple[FrameSet, FrameSet]):
    before = torch.get_rng_state()
    run(tmp_path / "run", frames, replace(CONFIG, epochs=1))
    assert torch.equal(before, torch.get_rng_state())


def test_the_time_limit_stops_a_training_and_leaves_a_whole_run(tmp_path: Path, frames: tuple[FrameSet, FrameSet]):
    result = run(tmp_path / "run", frames, replace(CONFIG, epochs=10_000, max_minutes=0.02))
    assert result.stopped_by == "time limit"
    assert 0 < result.epochs < 10_000
    load(tmp_path / "run")


def test_a_training_may_start_from_another_network(
    tmp_path: Path, frames: tuple[FrameSet, FrameSet], trained_run: Path
):
    start = load(trained_run)
    before = {name: value.clone() for name, value in start.model.state_dict().items()}
    # so low a rate leaves the weights as they were, whatever else is done to them
    run(tmp_path / "still", frames, replace(CONFIG, epochs=1, learning_rate=1e-12), start=start)
    after = load(tmp_path / "still")
    weights = dict(after.model.named_parameters())
    for name, value in start.model.named_parameters():
        torch.testing.assert_close(weights[name], value, rtol=0, atol=1e-9)
    assert after.manifest.started_from == start.manifest.weights_sha256
    assert after.manifest.trained_on == start.manifest.trained_on == ("abc",)  # each trial once
    assert start.manifest.started_from == ""
    for name, value in start.model.state_dict().items():
        assert torch.equal(value, before[name])


def test_it_does_not_start_from_a_network_of_another_kind(
    tmp_path: Path, frames: tuple[FrameSet, FrameSet], trained_run: Path
):
    start = load(trained_run)
    with pytest.raises(InputError, match="trial train-dry-0 is in both training and validation; split by trial"):
        run(tmp_path / "run", (frames[0], frames[0]))
    with pytest.raises(ModelError, match="has the head point, and histogram is to be trained; train point, or start"):
        run(tmp_path / "a", frames, replace(CONFIG, head="histogram"), start=start)


ADAPT = replace(RECIPES["adapt"], head="point", image_size=32, epochs=1, batch_size=11, epoch_frames=22, seed=3)


def test_adapting_moves_weights_and_leaves_the_statistics_of_the_normalisation(
    tmp_path: Path, frames: tuple[FrameSet, FrameSet], trained_run: Path
):
    start = load(trained_run)
    training = run(tmp_path / "run", frames, ADAPT, start=start)
    assert training.epochs == 1
    adapted, before = load(tmp_path / "run").model, start.model
    kept = dict(before.named_buffers())
    assert all(torch.equal(value, kept[name]) for name, value in adapted.named_buffers())
    weights = dict(before.named_parameters())
    assert all(not torch.equal(value, weights[name]) for name, value in adapted.named_parameters() if value.ndim > 1)


RATIO = replace(RECIPES["ratio"], image_size=32, epochs=30, batch_size=11, seed=3)


@pytest.fixture(scope="module")
def histogram_run(tmp_path_factory: pytest.TempPathFactory, frames: tuple[FrameSet, FrameSet]) -> Path:
    folder = tmp_path_factory.mktemp("histogram")
    # so long that its features tell frames apart
    run(folder, frames, replace(CONFIG, head="histogram", epochs=20))
    kept = load(folder)
    edges = kept.model.get_buffer("edges")
    edges.copy_(edges.half())  # as those of networks of the package
    save_checkpoint(folder, kept.model, kept.manifest)
    return folder


@pytest.fixture(scope="module")
def ratio_run(tmp_path_factory: pytest.TempPathFactory, frames: tuple[FrameSet, FrameSet], histogram_run: Path) -> Path:
    folder = tmp_path_factory.mktemp("ratio")
    run(folder, frames, RATIO, start=load(histogram_run))
    return folder


def test_a_second_answer_leaves_the_first_to_the_bit(
    frames: tuple[FrameSet, FrameSet], histogram_run: Path, ratio_run: Path
):
    before, after = load(histogram_run), load(ratio_run)
    kept, grown = before.model.state_dict(), after.model.state_dict()
    assert all(
        torch.equal(value, grown[name][: len(value)] if value.ndim else grown[name]) for name, value in kept.items()
    )
    assert before.manifest.calibration == after.manifest.calibration
    assert before.manifest.traction is None
    assert after.manifest.traction is not None
    assert after.manifest.traction.calibration.frames == len(frames[1])
    # what the training trials have of friction
    assert after.manifest.traction.friction[0] == pytest.approx(np.nanmin(frames[0].friction))
    inputs, *_ = frames[1].__getitems__(range(len(frames[1])))
    torch.testing.assert_close(after.predict(inputs), before.predict(inputs), atol=1e-6, rtol=0)


def test_a_second_answer_is_learnt(frames: tuple[FrameSet, FrameSet], ratio_run: Path):
    ratios = frames[1].traction_ratio.double().numpy()
    inputs, *_ = frames[1].__getitems__(range(len(frames[1])))
    answer = load(ratio_run).estimate(inputs).ratio
    assert answer is not None
    # better than the mean of the training, which is the best of those who see nothing
    blind = np.mean((frames[0].traction_ratio.double().numpy().mean() - ratios) ** 2)
    assert np.mean((answer.mean - ratios) ** 2) < 0.7 * blind


def test_an_evaluation_tells_what_was_told(frames: tuple[FrameSet, FrameSet], ratio_run: Path, histogram_run: Path):
    trained = load(ratio_run)
    untold, each = evaluate_frames(trained, frames[1]), evaluate_frames(trained, frames[1], friction="each")
    assert (untold.friction, each.friction) == ("", "that of each trial, given exactly")
    assert untold.ratio_r2.keys() == untold.conditions.keys()
    # one by one, as a slow reader would
    for value in np.unique(frames[1].friction):
        rows = np.flatnonzero(frames[1].friction == value)
        inputs, *_ = frames[1].__getitems__(rows.tolist())
        expected = trained.estimate(inputs, friction=float(value)).margin
        np.testing.assert_allclose(each.predictions.prediction[rows], expected, atol=1e-6)
    assert evaluate_frames(load(histogram_run), frames[1]).ratio_r2 == {}
