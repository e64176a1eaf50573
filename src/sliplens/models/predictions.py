"""Prediction of the safety margin of any number of frames from any source."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TypeAlias, Unpack

import numpy as np
import pyarrow as pa
from jaxtyping import Bool, Shaped
from torch import Tensor, nn

from sliplens._version import __version__
from sliplens.codec import TABLE_SUFFIXES, Result, read_written, write_tables
from sliplens.errors import InputError
from sliplens.extras import require_keywords
from sliplens.files import DEFAULT_NETWORK, DIFFERENCE_NETWORK, hash_json, require_new_table
from sliplens.friction import Friction, FrictionLike, as_friction
from sliplens.images import LEAST_TOUCH, Images, picture_change, soften
from sliplens.markers.camera import CAMERA_LIMIT_PX, CAMERA_REASON, CameraWatch
from sliplens.models.checkpoint import Estimate, Network
from sliplens.models.engines import Engine, make_engine
from sliplens.models.wrapping import Preprocess, open_run
from sliplens.progress import OnProgress, add_note, number_of, open_stage, report_progress, reporting
from sliplens.recordings import Dataset
from sliplens.recordings.capture import Capture
from sliplens.recordings.sensor import SensorProfile, load_profile
from sliplens.recordings.source import Frame, SourceOptions, Trials, open_trials
from sliplens.recordings.trial import ContactState
from sliplens.runner import LONGEST, MakePart, Work, run_table
from sliplens.shear import DIRECTION_LIMIT, FULL_CIRCLE, range_words

_REPORT_EVERY = 16
"""Batches from one report of progress to the next, about a second."""
_CAMERA_EVERY = 4
"""Frames of a recording of which one is compared with the reference for the camera's motion."""
LEVEL = 0.9
"""Confidence of the intervals."""
_FORCES = ("normal_force_n", "tangential_force_n")
_NETWORK = ("prediction", "sigma", "low_90", "high_90", "known", "withheld", "traction_ratio", "traction_ratio_sigma")
_COLUMNS = ("trial", "frame", "file", "time_s", "safety_margin", *_FORCES, "touches", *_NETWORK)
_TYPES = {
    **dict.fromkeys(("trial", "file", "withheld"), pa.string()),
    "frame": pa.int64(),
    "touches": pa.bool_(),
}
"""Types of columns that are no number of 64 bits."""
_Read: TypeAlias = Callable[[str, int, int], tuple[Capture, Iterator[tuple[int, Frame]]]]


@dataclass(frozen=True, kw_only=True)
class Predictions(Result):
    """Predicted safety margins, a row a frame.

    It is an Arrow table for other libraries: `pandas.DataFrame.from_arrow`, `polars.DataFrame`, `pyarrow.table`.
    """

    frames: int
    engine: str
    """Engine that ran the network, one of `ENGINES`."""
    unit: str = "margin"
    """Unit of the predictions; `margin` for safety margins in [0, 1], empty if unknown."""
    path: Path | None
    """File of the rows; None where they are kept in memory."""
    rows: pa.Table | None
    """The rows; None where they are in the file."""
    schema: pa.Schema | None = None
    """Columns of the rows in the file; None where they are kept in memory."""
    notes: tuple[str, ...] = ()
    """Assumptions, a sentence each."""

    def to_arrow(self) -> pa.Table:
        """Arrow table, a row a frame.

        Columns are `trial`, `frame`, `file` (of a folder of images), `time_s`, `safety_margin` (where the source has
        labels), `normal_force_n` and `tangential_force_n` (where it has forces), `touches` (contact by the labels, else
        by the difference from the untouched sensor), `prediction`, `sigma`, `low_90` and `high_90`, `known` (as in
        `Estimate`) for a network with a `Novelty`, `withheld`, and `traction_ratio` and `traction_ratio_sigma` for a
        network that predicts F_t / F_n. Unknown values are null: the time of images without a rate, sigma of a network
        with one number as its output, intervals without calibration. Predictions are not clipped to [0, 1].

        `withheld` is the reason why a prediction is not reliable, with the cure (`Estimate.withheld`), and null
        elsewhere. Where it is set, prediction, sigma, interval and traction ratio are null.
        """
        if self.rows is not None:
            return self.rows
        assert self.path is not None  # one of the two is given
        assert self.schema is not None
        return read_written(self.path, self.schema)

    def __len__(self) -> int:
        return self.frames

    @property
    def summary(self) -> str:
        """Predictions in a sentence."""
        rows, of_margin = self.to_arrow(), self.unit == "margin"
        values = rows["prediction"].drop_null().to_numpy()
        words = f"{number_of(self.frames, 'frame')} by {self.engine}"
        if of_margin and "touches" in rows.column_names and not rows["touches"].to_numpy().any():
            return f"{words}, nothing touches the sensor in any of them: there is no margin"
        if len(values):
            numbers = np.median(values), values.min(), values.max()
            middle, low, high = (
                f"{100 * number:.0f} %" if of_margin else f"{number:.3g} {self.unit}".rstrip() for number in numbers
            )
            words += f", {'safety margin' if of_margin else 'output'} {middle} (median), from {low} to {high}"
        return words if len(values) == self.frames else f"{words}, {self.frames - len(values):,} withheld"

    def __arrow_c_stream__(self, requested_schema: object = None) -> object:
        """Return the rows as an Arrow stream (the Arrow PyCapsule interface)."""
        return self.to_arrow().__arrow_c_stream__(requested_schema)

    @property
    def withheld(self) -> dict[str, int]:
        """Number of frames whose margin is withheld, by reason."""
        return dict(Counter(reason for reason in self.to_arrow()["withheld"].to_pylist() if reason is not None))


def lowest_frame(trial: pa.Table) -> int | None:
    """Find the frame of the lowest margin in the rows of a trial.

    Only frames that touch count, or all where none touches or contact is unknown. None if all margins are withheld.
    """
    margin = trial["prediction"].to_numpy()
    touches = trial["touches"].to_numpy().astype(bool) if "touches" in trial.column_names else np.ones(len(trial), bool)
    # of an untouched sensor a difference image shows noise alone, brightened
    counted = np.where(touches | ~touches.any(), margin, np.nan)
    return int(np.nanargmin(counted)) if np.isfinite(counted).any() else None


class _Options(SourceOptions, total=False):
    """Options of `predict` besides its own parameters."""

    on: str
    preprocess: Preprocess | None


def predict(
    run: Network | nn.Module | Path | str | Dataset | Sequence[Capture] | Images,
    source: Path | str | Dataset | Sequence[Capture] | Images | None = None,
    *,
    friction: FrictionLike | None = None,
    engine: str = "auto",
    batch_size: int = 8,
    device: str = "cpu",
    out: Path | str | None = None,
    overwrite: bool = False,
    on_progress: OnProgress | None = None,
    **options: Unpack[_Options],
) -> Predictions:
    """Predict the safety margin of every frame; memory does not grow with the recording if `out` is set.

    Parameters
    ----------
    run
        Network, its folder, the name of one that comes with sliplens, or a module that `wrap` takes. It may be left
        out: `predict("cup.mp4")` uses the network that the sensor's profile names, else `chromatouch-pair`, or
        `chromatouch-difference` for difference images.
    source
        Data set or one of its trials (`Dataset.load`), folder of images, video, bag, uint8 RGB frames (frames, height,
        width, 3), a list of images or their paths, or captures of `open_source`. Images without a reference are taken
        for difference images, compared before.
    friction
        Coefficient of friction of the object, for a network that predicts F_t / F_n: a number, (low, high), or a
        `Friction`, as estimated from slips (docs/networks.md). If None, any friction of the training is possible.
    engine
        `torch`, `openvino`, or `auto` for OpenVINO where it is installed and the frames are many.
    batch_size
        Frames predicted together; on a processor more are slower, their layers no longer fit its cache.
    device
        Device of a network that is loaded here: cpu or cuda.
    out
        File to write, Parquet or CSV by its ending; without an ending a folder, a Parquet data set with a file a
        trial. It appears when complete; an interrupted call continues. Rows stay in memory if None.
    overwrite
        If True, replace a file or folder `out`.
    on_progress
        Callback for progress.
    options
        `reference`, the untouched sensor as an image, or `reference_frame`, the number of the frame that shows it; for
        a recording without either, its first frame is assumed, with a note. `split`, `format`, `options` and `sensor`
        as `open_source` takes them. `on`, the executor: `serial`, `processes`, `processes=4` or `ray`.
        `preprocess`, for a module, as `wrap` takes it.

    Raises
    ------
    InputError
        If a parameter is missing or does not fit, or frames in memory that need a reference have none.
    ImageError
        If frames are of another size than those of the network's sensor.
    RecordingError
        If the source cannot be read.
    ShardError
        If some of many trials failed again and again, when all others are there.

    See Also
    --------
    evaluate : Compare predictions with labels.
    explain : Explain predictions.
    read_live : Predict frames of a running sensor.

    Examples
    --------
    >>> import numpy as np
    >>> import sliplens as sl
    >>> touch = np.zeros((2, 224, 224, 3), dtype=np.uint8)  # difference images: nothing has moved
    >>> predictions = sl.predict("chromatouch-difference", touch)
    >>> list(predictions.frame().columns)[:4]
    ['trial', 'frame', 'time_s', 'prediction']
    """
    require_keywords(predict, options)
    on = options.pop("on", "serial")
    preprocess = options.pop("preprocess", None)
    source_options: SourceOptions = {**options}  # pyright: ignore[reportAssignmentType]
    path = None if out is None else Path(out)
    if path is not None and path.suffix:
        require_new_table(path, suffix=TABLE_SUFFIXES, overwrite=overwrite)
    if batch_size < 1:
        raise InputError(f"--batch-size must be at least 1, got {batch_size}")
    network = None if source is None else open_run(run, device=device, preprocess=preprocess)
    recordings = run if source is None else source
    if isinstance(recordings, Network | nn.Module):
        raise InputError("there is no source; name a data set, a folder of images, a video, or frames")
    prior = None if friction is None else as_friction(friction)
    profile = options.get("sensor")
    if profile is not None:
        source_options["sensor"] = profile = load_profile(profile)
    with reporting(on_progress):
        with open_stage("Opening the source"):
            trials = open_trials(recordings, on=on, resumable=path is not None, **source_options)
        data = trials.source
        if profile is None and isinstance(data, Dataset):
            profile = data.profile(data.trials[0].sensor)
        if network is None:
            name, origin = DEFAULT_NETWORK, "which comes with sliplens"
            if profile is not None and profile.network is not None:
                name, origin = profile.network, f"which the profile {profile.name} names"
            elif any(kind.read_reference is None and not _is_recorded(kind) for kind in trials.kinds):
                name, origin = DIFFERENCE_NETWORK, "which comes with sliplens for difference images"
            add_note(f"no network was named, so {name} is used, {origin}")
            network = open_run(name, device=device)
        kinds = [assume_reference(network, capture) for capture in trials.kinds]
        notes = _list_notes(network, kinds, profile, friction=prior)
        for sentence in notes:
            add_note(sentence)
        metadata = {
            "sliplens.manifest_hash": hash_json(network.manifest),
            "sliplens.weights_sha256": network.manifest.weights_sha256,
        }
        if prior is not None:
            metadata["sliplens.friction"] = str(prior)
        schema = _schema(network, kinds, metadata)
        make = partial(make_engine, engine, network, frames=trials.frames, batch_size=batch_size)
        recipe = {"frames": trials.frames, "batch_size": batch_size, "engine": engine, **metadata}
        recipe |= {"columns": schema.names, "device": str(network.device), "source": trials.recipe}
        recipe["friction"] = prior and prior.digest
        written, rows = run_table(
            _Prediction(network=network, trials=trials, schema=schema, friction=prior, make=make),
            trials.parts(recipe),
            path,
            title=f"Predicting frames ({network.manifest.input})",
            recipe=recipe,
            resumable=trials.travels,
            on=on,
            overwrite=overwrite,
        )
    name = (written.metadata or {})[b"sliplens.engine"].decode()
    unit, schema = network.manifest.unit, path and written
    return Predictions(frames=trials.frames, engine=name, unit=unit, path=path, rows=rows, schema=schema, notes=notes)


def _list_notes(
    network: Network, captures: Sequence[Capture], profile: SensorProfile | None, *, friction: Friction | None
) -> tuple[str, ...]:
    """Refuse recordings and options that do not fit the network; return the assumptions about those that do."""
    if friction is not None:
        network.require_ratio()
    notes: list[str] = []
    for capture in captures:
        notes += [*capture.notes, *_require_comparable(network, capture)]
    notes += network.doubts(profile=profile)
    if friction is not None:
        notes += [f"The coefficient of friction is taken for {friction}.", *network.doubts(friction=friction)]
    return tuple(dict.fromkeys(notes))


def assume_reference(network: Network, trial: Capture) -> Capture:
    """Assume that the first frame of a recording shows the untouched sensor, if a network needs a reference."""
    if trial.read_reference is not None or not _is_recorded(trial) or not network.encoding.compares:
        return trial
    words = (
        f"{trial.trial}: its first frame was taken for the untouched sensor; if that touches, name another with "
        "--reference-frame N, or an image with --reference"
    )
    return replace(trial, reference_index=0, notes=(*trial.notes, words))


def _is_recorded(trial: Capture) -> bool:
    return trial.files is None and trial.time_s is not None  # recorded frames are not difference images


def _require_comparable(network: Network, trial: Capture) -> Iterator[str]:
    """Refuse a trial that does not fit the network; yield the assumptions about a trial that does."""
    network.require_frame_size(trial.frame_size)
    yield from network.doubts(sensor=trial.sensor)
    untouched, encoding = trial.read_reference, network.encoding
    if untouched is not None or not encoding.compares:  # difference images are black where nothing moved
        yield from network.doubts(frame=next(trial.read_frames()) if untouched is None else untouched())
    if untouched is not None:
        return
    if not _is_recorded(trial):
        network.require_kind(next(trial.read_frames()), what=trial.files[0] if trial.files else "the first frame")
    if not encoding.compares:
        if network.directions != FULL_CIRCLE:
            yield (
                f"{trial.trial}: no reference was given, so neither the direction of the pull nor a motion of the "
                f"camera is checked; the network was trained on {range_words(network.directions)} (90 is down)."
            )
    elif encoding.empty_is_black:
        yield (
            f"{trial.trial}: no reference was given, so its images were taken for difference images, which hide the "
            "pull."
        )
    else:
        raise InputError(
            f"a network on {encoding.name} images compares the frames of {trial.trial} with the untouched sensor; "
            "name its image with --reference IMAGE, or a frame of it with --reference-frame N"
        )


def _schema(network: Network, trials: Sequence[Capture], metadata: dict[str, str]) -> pa.Schema:
    present = {
        "file": any(trial.files is not None for trial in trials),
        "safety_margin": any(trial.safety_margin is not None for trial in trials),
        "known": network.manifest.novelty is not None,
        **dict.fromkeys(("traction_ratio", "traction_ratio_sigma"), network.manifest.traction is not None),
        "touches": all(trial.read_reference or _contact_states(trial) for trial in trials),
        **dict.fromkeys(_FORCES, any(trial.labels is not None for trial in trials)),
    }
    columns = [pa.field(name, _TYPES.get(name, pa.float64())) for name in _COLUMNS if present.get(name, True)]
    return pa.schema(columns, metadata={"sliplens.version": __version__, **metadata})


def _contact_states(trial: Capture) -> tuple[ContactState, ...]:
    """Return the contact states of the labels; none where any is unknown."""
    states = () if trial.labels is None else trial.labels.contact_state
    return () if ContactState.UNKNOWN in states else states


@dataclass(frozen=True, kw_only=True)
class _Prediction(Work):
    """Prediction of parts, (trial, first frame, number of frames), each to tables of at most `LONGEST` frames."""

    network: Network
    trials: Trials
    schema: pa.Schema
    friction: Friction | None
    make: Callable[[], Engine]

    @property
    def on_gpu(self) -> bool:
        return self.network.device.type != "cpu"

    def begin(self) -> MakePart:
        engine, read = self.make(), self.trials.reader()
        schema = self.schema.with_metadata({"sliplens.engine": engine.name, **(self.schema.metadata or {})})
        return lambda part, path: write_tables(self._tables(engine, read, part), path, schema)

    def _tables(self, engine: Engine, read: _Read, part: tuple[str, int, int]) -> Iterator[pa.Table]:
        _, first, count = part
        capture, frames = read(*part)
        capture = assume_reference(self.network, capture)
        network = self.network
        reference = None if capture.read_reference is None else capture.read_reference()
        check, size = _make_check(network, capture, reference), tuple(network.manifest.frame_size)
        encode = partial(network.encoding.encode, reference=reference, image_size=network.manifest.image_size)

        def batches(some: Iterator[tuple[int, Frame]], checks: list[tuple[bool, str | None]]) -> Iterator[Tensor]:
            for number, batch in enumerate(iter(lambda: list(islice(some, engine.batch_size)), []), start=1):
                checks.extend(check(*numbered) for numbered in batch)
                images = np.stack([frame for _, frame in batch])
                if images.shape[1:3] != size:
                    network.require_frame_size(images.shape[1:3])
                yield encode(images)
                if not number % _REPORT_EVERY:
                    report_progress(batch[-1][0] + 1 - first, count)

        for begin in range(first, first + count, LONGEST):
            checks: list[tuple[bool, str | None]] = []
            estimate = network.estimate(batches(islice(frames, LONGEST), checks), friction=self.friction, engine=engine)
            touches = np.array([touch for touch, _ in checks])
            # of a strange picture the direction of the shear says nothing
            withheld = [
                doubt if doubt == CAMERA_REASON else strange or doubt
                for strange, (_, doubt) in zip(estimate.withheld(touches), checks, strict=True)
            ]
            believed = np.array([reason is None for reason in withheld])
            here = slice(begin, begin + len(checks))
            columns = _columns(estimate, capture, here, believed=believed) | {"touches": touches, "withheld": withheld}
            yield pa.table(
                [
                    pa.array([None] * len(checks) if columns[name] is None else columns[name], kind, from_pandas=True)
                    for name, kind in zip(self.schema.names, self.schema.types, strict=True)
                ],
                schema=self.schema,
            )


def _make_check(
    network: Network, capture: Capture, reference: Frame | None
) -> Callable[[int, Frame], tuple[bool, str | None]]:
    """Make the check of the frames of a trial in order: contact, and why the margin may be wrong."""
    states = _contact_states(capture)
    if reference is None:
        return lambda number, _: (not states or states[number] != ContactState.NO_CONTACT, None)
    untouched, shear, camera = soften(reference), network.shear_estimator(reference), CameraWatch(reference)
    moved, directions, reason = False, network.directions, network.direction_reason

    def check(number: int, frame: Frame) -> tuple[bool, str | None]:
        nonlocal moved
        if states:
            touches = states[number] != ContactState.NO_CONTACT
        else:
            touches = picture_change(soften(frame), untouched) >= LEAST_TOUCH
        # a camera that has moved stays so; images of a folder are of any time
        if number % _CAMERA_EVERY == 0 or capture.files is not None:
            motion = camera.update(frame, touches=touches)
            moved = motion is not None and motion.excess_px > CAMERA_LIMIT_PX
        if moved:
            return touches, CAMERA_REASON
        turned = shear is not None and touches and shear.estimate(frame).excess(directions) > DIRECTION_LIMIT
        return touches, reason if turned else None

    return check


def _columns(
    estimate: Estimate, trial: Capture, here: slice, *, believed: Bool[np.ndarray, " frames"]
) -> dict[str, Shaped[np.ndarray, " frames"] | Sequence[str | None] | None]:
    """Make the columns of consecutive frames; None for what is unknown, NaN where the network is not believed."""
    labels, ratio = trial.labels, estimate.ratio
    low, high = estimate.interval(LEVEL) or (None, None)
    numbers = {
        "prediction": estimate.margin,
        "sigma": estimate.sigma,
        "low_90": low,
        "high_90": high,
        "traction_ratio": ratio and ratio.mean,
        "traction_ratio_sigma": ratio and ratio.sigma,
    }
    recorded = {"time_s": trial.time_s, "safety_margin": trial.safety_margin}
    recorded |= {name: labels and getattr(labels, name) for name in _FORCES}
    return {
        "trial": [trial.trial] * len(believed),
        "frame": np.arange(here.start, here.stop),
        "file": trial.files and trial.files[here],
        "known": estimate.known,
        **{name: None if values is None else np.where(believed, values, np.nan) for name, values in numbers.items()},
        **{name: None if values is None else values[here] for name, values in recorded.items()},
    }
