"""Safety margins of any number of frames, from any source, in the memory of a few batches."""

from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice, pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa
from jaxtyping import Float
from torch import Tensor

from sliplens._version import __version__
from sliplens.codec import TABLE_SUFFIXES, read_written, write_tables
from sliplens.errors import InputError
from sliplens.files import DEFAULT_NETWORK, DIFFERENCE_NETWORK, hash_json
from sliplens.friction import Friction, FrictionLike, as_friction
from sliplens.markers.camera import CAMERA_LIMIT_PX, CAMERA_REASON, CameraWatch
from sliplens.models.checkpoint import Estimate, Network, open_run, sensor_kind
from sliplens.models.engines import Engine, make_engine
from sliplens.models.sequence import require_frequent
from sliplens.progress import OnProgress, note, number_of, report_progress, reporting, stage
from sliplens.recordings import Dataset, load_dataset
from sliplens.recordings.capture import Capture
from sliplens.recordings.dataset import DATASET_FILE
from sliplens.recordings.labels.lag import LEAST_TOUCH, picture_change, soften
from sliplens.recordings.options import ReadOptions
from sliplens.recordings.sensor import SensorProfile, load_profile
from sliplens.recordings.source import Frame, Frames, Trials, open_trials
from sliplens.recordings.trial import ContactState
from sliplens.runner import LONGEST, MakePart, Work, require_new_table, run_table
from sliplens.shear import FULL_CIRCLE, range_words

_CAMERA_EVERY = 4
"""Frames of a recording of which one is compared with the reference for the camera's motion."""
LEVEL = 0.9
"""Confidence of the intervals."""
_COLUMNS = {
    "trial": pa.string(),
    "frame": pa.int64(),
    "file": pa.string(),
    "time_s": pa.float64(),
    "safety_margin": pa.float64(),
    "normal_force_n": pa.float64(),
    "tangential_force_n": pa.float64(),
    "touches": pa.bool_(),
    "prediction": pa.float64(),
    "sigma": pa.float64(),
    "low_90": pa.float64(),
    "high_90": pa.float64(),
    "known": pa.float64(),
    "withheld": pa.string(),
    "traction_ratio": pa.float64(),
    "traction_ratio_sigma": pa.float64(),
}


_FORCES = ("normal_force_n", "tangential_force_n")


@dataclass(frozen=True, kw_only=True)
class TrialMargins:
    """Margins that a network reads in one trial, as a person asks for them first."""

    trial: str
    margin: Float[np.ndarray, " frames"]
    """In margin units, frame by frame; not clipped to [0, 1], NaN where it is withheld."""
    lowest: int | None
    """Frame of the lowest margin, of those that touch; of all where none does, or nobody knows. None where the margin
    of all of them is withheld."""
    withheld: int
    """Number of frames whose margin is withheld."""
    touching: int | None
    """How many frames touch; None where nobody knows."""
    time_s: float | None
    """Time of that frame; None where it is not known."""
    interval: tuple[float, float] | None
    """Ends of its 90 % interval; None for a network that was never calibrated, and without such a frame."""


@dataclass(frozen=True, kw_only=True, repr=False)
class Predictions:
    """Safety margins that a network reads, a row a frame.

    It is a table to whatever takes one of Arrow: `pandas.DataFrame.from_arrow`, `polars.DataFrame`, `pyarrow.table`.
    """

    frames: int
    engine: str
    """Engine that ran the network, one of `ENGINES`."""
    path: Path | None
    """File of the rows; None where they are kept in memory."""
    rows: pa.Table | None
    """The rows; None where they are in the file."""
    schema: pa.Schema | None = None
    """Columns of the rows in the file; None where they are kept in memory."""
    notes: tuple[str, ...] = ()
    """What was assumed, a sentence each."""

    def frame(self) -> pa.Table:
        """Arrow table; `.to_pandas()` where pandas is installed.

        Columns are `trial`, `frame`, `file` (of a folder of images), `time_s`, `safety_margin` (where the source has
        labels), `normal_force_n` and `tangential_force_n` (where it has forces), `touches` (whether anything does, by
        the labels, else by how far the picture is from that of the untouched sensor), `prediction`, `sigma`, `low_90`
        and `high_90`, `known` (as in `Estimate`) of a network that tells it, `withheld`, and `traction_ratio` and
        `traction_ratio_sigma` of one that tells F_t / F_n. What is not known is null: the time of images without a
        rate, sigma of a network that answers with one number, intervals of one that was never calibrated. Predictions
        are not clipped to [0, 1].

        `withheld` says why a frame is not to be believed, with the cure (`Estimate.withheld`), and is null elsewhere.
        Where it is set, whatever the network predicts is null: prediction, sigma, interval and traction ratio.
        """
        if self.rows is not None:
            return self.rows
        assert self.path is not None  # one of the two is given
        assert self.schema is not None
        return read_written(self.path, self.schema)

    def __len__(self) -> int:
        return self.frames

    def __repr__(self) -> str:
        told = f"Predictions of {number_of(self.frames, 'frame')} by {self.engine}"
        return f"{told}, in {self.path}" if self.rows is None else f"{told}\n{self.rows.to_string(preview_cols=3)}"

    def __arrow_c_stream__(self, requested_schema: object = None) -> object:
        """Rows for whatever reads Arrow's stream (the Arrow PyCapsule interface)."""
        return self.frame().__arrow_c_stream__(requested_schema)

    @property
    def withheld(self) -> dict[str, int]:
        """Number of frames whose margin is withheld, by reason."""
        return dict(Counter(reason for reason in self.frame()["withheld"].to_pylist() if reason is not None))

    def trials(self) -> list[TrialMargins]:
        """Course and lowest margin of every trial."""
        table = self.frame().combine_chunks()
        names = table["trial"].to_numpy(zero_copy_only=False)
        numbers = {
            name: table[name].to_numpy(zero_copy_only=False).astype(np.float64)
            for name in ("prediction", "time_s", "low_90", "high_90")
        }
        known = "touches" in table.column_names
        touches = table["touches"].to_numpy(zero_copy_only=False).astype(bool) if known else np.ones(len(table), bool)
        believed = table["withheld"].is_null().to_numpy(zero_copy_only=False)
        # the rows of a trial stand together
        bounds = dict.fromkeys([0, *(np.flatnonzero(names[1:] != names[:-1]) + 1).tolist(), len(names)])
        found = []
        for first, end in pairwise(bounds):
            own = {name: values[first:end] for name, values in numbers.items()}
            touching = touches[first:end]
            # of an untouched sensor a difference image shows noise alone, brightened
            counted = np.where(touching | ~touching.any(), own["prediction"], np.nan)
            lowest = int(np.nanargmin(counted)) if np.isfinite(counted).any() else None
            at = {name: np.nan if lowest is None else float(values[lowest]) for name, values in own.items()}
            found.append(
                TrialMargins(
                    trial=names[first],
                    margin=own["prediction"],
                    lowest=lowest,
                    withheld=end - first - int(believed[first:end].sum()),
                    touching=int(touching.sum()) if known else None,
                    time_s=at["time_s"] if np.isfinite(at["time_s"]) else None,
                    interval=(at["low_90"], at["high_90"]) if np.isfinite(at["low_90"]) else None,
                )
            )
        return found


def predict(
    run: Network | Path | str | Frames | Dataset | Sequence[Capture],
    source: Path | str | Frames | Dataset | Sequence[Capture] | None = None,
    *,
    reference: Path | str | Frame | None = None,
    reference_frame: int | None = None,
    split: str | None = None,
    format: str | None = None,
    options: ReadOptions | None = None,
    friction: FrictionLike | None = None,
    sequence: bool = False,
    sensor: SensorProfile | Path | str | None = None,
    engine: str = "auto",
    batch_size: int = 8,
    device: str = "cpu",
    on: str = "serial",
    retry_failed: bool = False,
    out: Path | str | None = None,
    overwrite: bool = False,
    on_progress: OnProgress | None = None,
) -> Predictions:
    """Read the safety margin of every frame; memory does not grow with the recording where `out` is named.

    Parameters
    ----------
    run
        Network, its folder, or the name of one that comes with sliplens. It may be left out: `predict("cup.mp4")` reads
        the source with the network that its sensor's profile names, else with `chromatouch-pair`, or
        `chromatouch-difference` where it is difference images.
    source
        Data set, folder of images, video, bag, uint8 RGB frames (frames, height, width, 3), or what `open_source` gave.
        Images without a reference are taken for difference images, compared before.
    reference, reference_frame
        The sensor untouched: image, or number of the frame that shows it. Where nobody tells it of a recording, its
        first frame is taken for it, and a note says so.
    split, format, options, sensor
        As `open_source` takes them.
    friction
        What is known of the object's coefficient of friction, for a network that tells F_t / F_n: a number, (low,
        high), or a `Friction`, such as one learnt from slips. If None, it may be any that the training had.
    sequence
        Read each trial in order: what the frames of a contact so far tell of its friction and of sliding counts too
        (`Follower`). The times of the frames must be known, and friction is not told then.
    engine
        `torch`, `openvino`, or `auto` for OpenVINO where it is installed and the frames are many.
    batch_size
        Frames predicted together; on a processor more are slower, their layers no longer fit its cache.
    device
        Device of a network that is loaded here: cpu or cuda.
    on, retry_failed
        Where the trials are read, a row of `runner.EXECUTORS`: `serial`, `processes`, `processes=4`, `ray`; and
        whether those are tried again that failed three times before.
    out
        File to write, Parquet, CSV or JSON by its ending; without an ending a folder, a Parquet data set with a file a
        trial. Whole or not at all, and interrupted it goes on after its last trial; rows are kept in memory if None.

    Raises
    ------
    InputError
        If something named is missing or does not fit, or frames in memory that need a reference have none.
    ImageError
        If frames are of another size than those of the network's sensor.
    RecordingError
        If the source cannot be read.
    PartError
        If some of many trials failed again and again, when all others are there.

    Examples
    --------
    >>> import numpy as np
    >>> import sliplens as sl
    >>> touch = np.zeros((2, 224, 224, 3), dtype=np.uint8)  # difference images: nothing has moved
    >>> predictions = sl.predict("chromatouch-difference", touch)
    >>> predictions.frame().column_names[:4]
    ['trial', 'frame', 'time_s', 'prediction']
    """
    path = None if out is None else Path(out)
    if path is not None and path.suffix:
        require_new_table(path, suffix=TABLE_SUFFIXES, overwrite=overwrite)
    if batch_size < 1:
        raise InputError(f"--batch-size must be at least 1, got {batch_size}")
    trained = None if source is None else open_run(run, device=device)
    read = run if source is None else source
    if isinstance(read, Network):
        raise InputError("name what to read: a data set, a folder of images, a video, or frames")
    known = None if friction is None else as_friction(friction)
    with stage(on_progress, "Opening the source"):
        trials = open_trials(
            read,
            on=on,
            resumable=path is not None,
            reference=reference,
            reference_frame=reference_frame,
            split=split,
            format=format,
            options=options,
            sensor=None if sensor is None else load_profile(sensor),
        )
    profile = _find_profile(trials, sensor)
    if trained is None:
        name, named_by = _find_network(trials, profile)
        note(on_progress, f"no network was named, so {name} reads it, {named_by}")
        trained = open_run(name, device=device)
    if known is not None:
        trained.require_ratio()
    kinds = [_assume_reference(trained, one) for one in trials.kinds]
    if sequence:
        _require_order(trained, kinds, friction=known)
    notes = tuple(dict.fromkeys(words for one in kinds for words in (*one.notes, *_require_comparable(trained, one))))
    turned = None if profile is None else trained.doubt_direction(profile)
    notes = notes if turned is None else (*notes, turned)
    metadata = {
        "sliplens.source": kinds[0].opened,
        "sliplens.manifest_hash": hash_json(trained.manifest),
        "sliplens.weights_sha256": trained.manifest.weights_sha256,
    }
    if known is not None:
        doubt = trained.doubt_friction(known)
        notes = (*notes, f"The coefficient of friction is taken for {known}.", *([] if doubt is None else [doubt]))
        metadata["sliplens.friction"] = str(known)
    if sequence:
        assert trained.manifest.sequence is not None  # `_require_order`
        notes = (*notes, "Frames were read in order: each answer counts those of its contact before it.")
        metadata["sliplens.sequence"] = trained.manifest.sequence.weights_sha256
    for sentence in notes:
        note(on_progress, sentence)
    schema = _schema(trained, kinds, metadata)
    run_with = {"frames": trials.frames, "batch_size": batch_size}
    make = partial(make_engine, engine, trained, **run_with)
    recipe = run_with | {"engine": engine, **metadata}
    recipe |= {"columns": schema.names, "device": str(trained.device), "source": trials.recipe}
    recipe["friction"] = known and known.digest
    with reporting(on_progress):
        written, rows = run_table(
            _Reading(
                trained=trained, trials=trials, schema=schema, friction=known, sequence=sequence, make_engine=make
            ),
            trials.parts(recipe, longest=None if sequence else LONGEST),
            path,
            title=f"Predicting frames ({trained.manifest.input})",
            recipe=recipe,
            resumable=trials.travels,
            on=on,
            retry_failed=retry_failed,
            overwrite=overwrite,
        )
    name = (written.metadata or {})[b"sliplens.engine"].decode()
    return Predictions(frames=trials.frames, engine=name, path=path, rows=rows, schema=path and written, notes=notes)


def _find_profile(trials: Trials, sensor: SensorProfile | Path | str | None) -> SensorProfile | None:
    """Profile that is named, or that a data set keeps of its first trial's sensor."""
    if sensor is not None:
        return load_profile(sensor)
    source = trials.source
    if isinstance(source, Path) and (source / DATASET_FILE).is_file():
        source = load_dataset(source)
    return source.profile(source.trials[0].sensor) if isinstance(source, Dataset) else None


def _find_network(trials: Trials, profile: SensorProfile | None) -> tuple[str, str]:
    """Network for a source where none is named, and who names it."""
    if profile is not None and profile.network is not None:
        return profile.network, f"which the profile {profile.name} names"
    if any(one.read_reference is None and not _is_recorded(one) for one in trials.kinds):
        return DIFFERENCE_NETWORK, "which comes with sliplens for difference images"
    return DEFAULT_NETWORK, "which comes with sliplens"


def _require_order(trained: Network, trials: Sequence[Capture], *, friction: Friction | None) -> None:
    """Refuse to read frames in order where the network was not taught to, or nobody knows when they were taken."""
    trained.follow(friction=friction)
    if any(one.time_s is None for one in trials):
        raise InputError(
            "--sequence reads frames by their times, and nobody tells them here; leave it out, or read a recording "
            "whose times are known"
        )
    for one in trials:
        assert one.time_s is not None
        require_frequent(one.time_s, what=one.name)


def _assume_reference(trained: Network, trial: Capture) -> Capture:
    """Take the first frame of a recording for the untouched sensor, where a network needs it and nobody tells it."""
    if trial.read_reference is not None or not _is_recorded(trial) or trained.encoding.name == "raw":
        return trial
    words = (
        f"{trial.name}: its first frame was taken for the untouched sensor; if that touches, name another with "
        "--reference-frame N, or an image with --reference"
    )
    return replace(trial, reference_index=0, notes=(*trial.notes, words))


def _is_recorded(trial: Capture) -> bool:
    return trial.files is None and trial.time_s is not None  # nobody compares frames before they are recorded


def _require_comparable(trained: Network, trial: Capture) -> Iterator[str]:
    """Refuse a trial that the network cannot read; gives what is assumed of one that it can."""
    trained.require_frame_size(trial.frame_size)
    encoding = trained.encoding
    doubt = trained.doubt(trial.sensor)
    if doubt is not None:
        yield doubt + _compare_markers(trained, trial)
    untouched = trial.read_reference
    if untouched is not None or encoding.name == "raw":  # difference images are black where nothing moved
        grey = trained.doubt_colour(next(trial.read_frames()) if untouched is None else untouched())
        if grey is not None:
            yield grey
    if untouched is None and not _is_recorded(trial):
        trained.require_kind(next(trial.read_frames()), what=trial.files[0] if trial.files else "the first frame")
    directions = trained.manifest.pull_direction_deg or FULL_CIRCLE
    if untouched is None and encoding.name == "raw" and directions != FULL_CIRCLE:
        yield (
            f"{trial.name}: no reference was given, so neither the direction of the pull nor a motion of the camera is "
            f"checked; the network was trained on {range_words(directions)} (90 is down)."
        )
    if untouched is not None or encoding.name == "raw":
        return
    if not encoding.empty_is_black:
        raise InputError(
            f"a network on {encoding.name} images compares the frames of {trial.name} with the untouched sensor; "
            "name its image with --reference IMAGE, or a frame of it with --reference-frame N"
        )
    unseen = (
        f", which hide the direction of the pull; the network was trained on {range_words(directions)} (90 is down)"
    )
    unseen = "" if directions == FULL_CIRCLE else unseen
    yield f"{trial.name}: no reference was given, so its images were taken for difference images{unseen}."


def _compare_markers(trained: Network, trial: Capture) -> str:
    """How far apart the markers are, beside those that a network of a simulated sensor learned from."""
    # together they take seconds to import, and most frames need none of them
    from scipy.spatial import KDTree  # noqa: PLC0415

    from sliplens.markers.gel import marker_spacing  # noqa: PLC0415
    from sliplens.simulation.sensor import SENSORS  # noqa: PLC0415

    known = SENSORS[kind] if (kind := sensor_kind(trained.manifest.sensor)) in SENSORS else None
    if known is None or trial.read_reference is None:
        return ""
    learned = known.geometry.project(known.geometry.marker_positions())
    wanted_px = float(np.median(KDTree(learned).query(learned, k=2)[0][:, 1]))
    found_px = marker_spacing(trial.read_reference())
    if np.isnan(found_px):
        return "; no markers were found, and it learned from how markers move: do not trust it here"
    return f"; markers are {found_px:.1f} pixels apart, those it learned from {wanted_px:.1f}"


def _schema(trained: Network, trials: Sequence[Capture], metadata: dict[str, str]) -> pa.Schema:
    known = {
        "file": any(trial.files is not None for trial in trials),
        "safety_margin": any(trial.safety_margin is not None for trial in trials),
        "known": trained.novelty is not None,
        **dict.fromkeys(("traction_ratio", "traction_ratio_sigma"), trained.manifest.traction is not None),
        "touches": all(trial.read_reference or _states(trial) for trial in trials),
        **dict.fromkeys(_FORCES, any(trial.labels is not None for trial in trials)),
    }
    columns = [pa.field(name, kind) for name, kind in _COLUMNS.items() if known.get(name, True)]
    return pa.schema(columns, metadata={"sliplens.version": __version__, **metadata})


def _states(trial: Capture) -> tuple[ContactState, ...]:
    """Contact states of the labels; none where they do not tell them."""
    states = () if trial.labels is None else trial.labels.contact_state
    return () if ContactState.UNKNOWN in states else states


@dataclass(frozen=True, kw_only=True)
class _Reading(Work):
    """Work on shards of (trial, first frame, number of frames): their rows, as a Parquet file."""

    trained: Network
    trials: Trials
    schema: pa.Schema
    friction: Friction | None
    sequence: bool
    make_engine: Callable[[], Engine]

    @property
    def on_gpu(self) -> bool:
        return self.trained.device.type != "cpu"

    def begin(self) -> MakePart:
        ready, read = self.make_engine(), self.trials.reader()
        schema = self.schema.with_metadata({"sliplens.engine": ready.name, **(self.schema.metadata or {})})

        def make(item: tuple[str, int, int], path: Path) -> None:
            rows = self._rows(ready, *read(*item), count=item[-1])
            write_tables((pa.Table.from_pydict(some, schema) for some in rows), path, schema)

        return make

    def _rows(
        self,
        engine: Engine,
        capture: Capture,
        frames: Iterator[tuple[int, Frame]],
        *,
        count: int,
    ) -> Iterator[dict[str, list]]:
        """Columns of some thousand frames at a time: what is read in order is cut nowhere else."""
        # plain numbers: small arrays kept between the large ones of each batch would leave holes in the memory
        rows: dict[str, list] = {name: [] for name in self.schema.names}
        done = 0
        capture = _assume_reference(self.trained, capture)
        reference = None if capture.read_reference is None else capture.read_reference()
        untouched, states = None if reference is None else soften(reference), _states(capture)
        # batches are encoded while the ones before are under way; first frame of each, which touch, and doubts of them
        encoded: deque[tuple[int, list[bool], list[str | None]]] = deque()
        shear = None if reference is None else self.trained.shear_estimator(reference)
        camera, moved = None if reference is None else CameraWatch(reference), False
        follower = self.trained.follow() if self.sequence else None
        if follower is not None and capture.time_s is not None:
            require_frequent(capture.time_s, what=capture.name)  # `_require_order` saw one trial of each sensor

        def encode() -> Iterator[Tensor]:
            nonlocal moved
            while batch := list(islice(frames, engine.batch_size)):
                first, images = batch[0][0], [frame for _, frame in batch]
                if states:
                    touches = [state != ContactState.NO_CONTACT for state in states[first : first + len(batch)]]
                elif untouched is not None:
                    touches = [picture_change(soften(frame), untouched) >= LEAST_TOUCH for frame in images]
                else:
                    touches = [True] * len(batch)
                doubts: list[str | None] = []
                for at, (touch, frame) in enumerate(zip(touches, images, strict=True), start=first):
                    # a camera that has moved stays so; images of a folder are of any time
                    if camera is not None and (at % _CAMERA_EVERY == 0 or capture.files is not None):
                        motion = camera.update(frame, touches=touch)
                        moved = motion is not None and motion.excess_px > CAMERA_LIMIT_PX
                    astray = self.trained.doubt_shear(shear.estimate(frame)) if shear is not None and touch else None
                    doubts.append(CAMERA_REASON if moved else astray)
                encoded.append((first, touches, doubts))
                yield self.trained.encode(np.stack(images), reference)

        for answers in engine.answers(encode()):
            first, touches, doubts = encoded.popleft()
            estimate = self.trained.to_estimate(*answers, friction=self.friction)
            reasons = zip(estimate.withheld(np.array(touches)), doubts, strict=True)
            # of a strange picture the direction of the shear says nothing
            withheld = [doubt if doubt == CAMERA_REASON else strange or doubt for strange, doubt in reasons]
            if follower is not None:
                assert capture.time_s is not None  # `_require_order`
                times, believed = capture.time_s[first : first + len(touches)], [reason is None for reason in withheld]
                estimate = follower.update(estimate, times, np.array(touches), believed=np.array(believed))
            columns = _columns(estimate, capture, first, withheld=withheld) | {"touches": touches}
            for name, values in columns.items():
                if name in rows:
                    rows[name].extend(values)
            report_progress(done := done + len(touches), count)
            if len(rows["frame"]) >= LONGEST:
                yield rows
                rows = {name: [] for name in rows}
        if rows["frame"]:
            yield rows


def _columns(estimate: Estimate, trial: Capture, first: int, *, withheld: list[str | None]) -> dict[str, list]:
    count = len(estimate.margin)
    here, unknown = slice(first, first + count), [None] * count
    low, high = estimate.interval(LEVEL) or (None, None)
    ratio = estimate.ratio
    predicted = {
        "prediction": estimate.margin,
        "sigma": estimate.sigma,
        "low_90": low,
        "high_90": high,
        "traction_ratio": None if ratio is None else ratio.mean,
        "traction_ratio_sigma": None if ratio is None else ratio.sigma,
    }
    believed = np.array([reason is None for reason in withheld])
    numbers = {name: None if v is None else np.where(believed, v, np.nan) for name, v in predicted.items()}
    labels = trial.labels
    recorded = {"time_s": trial.time_s, "safety_margin": trial.safety_margin}
    recorded |= {name: None if labels is None else getattr(labels, name) for name in _FORCES}
    numbers |= {name: None if v is None else v[here] for name, v in recorded.items()}
    numbers["known"] = estimate.known
    return {
        "trial": [trial.name] * count,
        "frame": list(range(first, first + count)),
        "file": list(trial.files[here]) if trial.files else unknown,
        "withheld": withheld,
        # NaN as null: nothing is known
        **{name: unknown if v is None else pa.array(v, from_pandas=True).to_pylist() for name, v in numbers.items()},
    }
