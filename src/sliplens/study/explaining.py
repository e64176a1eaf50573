"""Public call that explains frames, its folder, the strip of one trial, and the proof of a map."""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, TypedDict, Unpack, cast

import numpy as np
from jaxtyping import Float32, UInt8
from torch import nn

from sliplens.errors import InputError, SliplensError
from sliplens.explainers import frames as choosing
from sliplens.explainers.contract import Explainer
from sliplens.explainers.explain import MethodMaps, Methods, choose_explainers, explain_rows, join_maps, with_markers
from sliplens.explainers.frames import MARGIN_LEVELS, Baseline, ChosenFrames, FrameSelection
from sliplens.explainers.occlusion import marker_regions, markers_in_recording, to_network_px
from sliplens.explainers.table import EXPLAINERS, RECOMMENDED_METHOD
from sliplens.extras import require_keywords
from sliplens.files import remove
from sliplens.images import Images
from sliplens.models import Network
from sliplens.models.wrapping import Preprocess, open_run
from sliplens.progress import OnProgress, add_note, ignore, number_of, open_stage, reporting
from sliplens.recordings import Dataset, Recording, load_dataset
from sliplens.recordings.dataset import DATASET_FILE
from sliplens.recordings.options import ReadOptions, option_flags
from sliplens.recordings.sensor import SensorProfile, load_profile
from sliplens.recordings.source import SourceOptions, open_source, read_reference
from sliplens.results.explanation import BASELINES, Explanation, MovedMarkers, Strip, StripReadings, load_explanation
from sliplens.runner import Part, keep_record, part
from sliplens.simulation.trials import put_markers_back, rebuild_trial, visible_markers
from sliplens.study.choice import marker_sums, study_explainers, without_markers
from sliplens.study.stages import MakeRecord, Stage


class Running(TypedDict, total=False):
    """Options of where and how a public call runs."""

    device: str
    """Device of the network: `cpu`, `cuda` or `cuda:1`; `cpu` by default."""
    on: str
    """Where maps are made: `serial` (default), `processes`, `processes=4`."""
    overwrite: bool
    """If True, replace the folder `out`."""
    preprocess: Preprocess | None
    """Preprocessing of a PyTorch module, as `wrap` takes it."""
    on_progress: OnProgress | None
    """Callback for progress: number of items done, and of all items."""


class ExplainOptions(Running, total=False):
    """Options of `explain` besides its own parameters: facts about the source, as `predict` takes them."""

    reference_frame: int | None
    """Number of the frame that shows the untouched sensor; without a reference the first frame of a recording."""
    trial: str | None
    """Name of one trial of a data set or bag."""
    format: str | None
    """Name of the format of a recording (docs/recordings.md); recognised if not given."""
    options: ReadOptions | None


def explain(
    run: Network | nn.Module | Path | str,
    source: Dataset | Recording | Path | str | Images,
    *,
    reference: Path | str | Images | None = None,
    baseline: Baseline | Images | Path | str | None = None,
    method: Methods | None = None,
    budget: float | None = None,
    select: FrameSelection | None = None,
    sensor: SensorProfile | Path | str | None = None,
    labels_in_names: bool = False,
    out: Path | str | None = None,
    **running: Unpack[ExplainOptions],
) -> Explanation:
    """Explain why a network predicts these safety margins rather than that of a baseline.

    Parameters
    ----------
    run
        The network, its folder, the name of one that comes with sliplens, or a PyTorch module that `wrap` takes.
    source, reference
        Camera frames T_n, 8-bit RGB, with the frame of the untouched sensor T_0; or a folder of images or a recording
        with the image of the untouched sensor, where it holds none. Without a reference they are absolute difference
        images |T_n - T_0|. Or a data set, of which frames along the safety margin are taken, or one of its trials
        (`Dataset.load`).
    baseline
        What predictions are compared with: `untouched`, the untouched sensor; `stick`, the last frame before the pull
        of the same trial; `black`, `mean` (the mean colour of the frames) or `blurred` (each frame blurred), for
        networks without a reference; or a frame of the sensor, or the path of its image. If None, `stick` for data sets
        and recordings, `untouched` for arrays and folders of images, or `black` where there is no reference. Where no
        stick frame is found, the untouched sensor takes its place, with a warning.
    method
        Name of a method (docs/explainers.md), an explainer such as `get_explainer("occlusion", tile_px=8)`, or several
        of them. If None, Shapley values of the markers, or of tiles where no markers are detected.
    budget
        Share of the channels that `poly-cam` measures at first; below 1 it is faster. If None, 1 for one frame and 0.15
        for several.
    select
        Frames of a data set; by default one dry test trial at six safety margins.
    sensor
        Profile of the sensor of a folder or recording, its file, or the name of one that comes with sliplens.
    labels_in_names
        If True, names of images such as `image_433_20.png` hold the safety margin in percent.
    out
        Folder to write: the record, overlays of every map, and a panel of them; nothing is written if None. Until it
        is complete, each map appears in `.NAME.partial/overlays` beside it. An interrupted call continues after its
        last map.
    running
        Options of `ExplainOptions`.

    Raises
    ------
    InputError
        If there is no such method or option, the source has no such frames, the network needs a reference, or the
        folder holds something else.
    ImageError
        If the frames are not of the size of the network's sensor.
    PartError
        If some of many maps failed three times, when all others are done.

    See Also
    --------
    score : Measure the faithfulness of the maps.
    run_study : Compare methods on a data set.
    plot : Plot the maps.

    Examples
    --------
    >>> import numpy as np
    >>> import sliplens as sl
    >>> touched = np.zeros((1, 224, 224, 3), dtype=np.uint8)
    >>> touched[:, 80:120, 90:150] = 90
    >>> explanation = sl.explain("chromatouch-difference", touched, method="grad-cam")
    >>> explanation.relevance["grad-cam"].shape
    (1, 224, 224)
    """
    require_keywords(explain, running)
    if isinstance(method, list | tuple) and not method:
        raise InputError("there is no method; name one or more, or leave it out for the recommended one")
    for name in [method] if isinstance(method, str) else method if isinstance(method, Sequence) else ():
        if isinstance(name, str):
            EXPLAINERS.pick(name)
    network = open_run(run, device=running.get("device", "cpu"), preprocess=running.get("preprocess"))
    profile = None if sensor is None else load_profile(sensor)
    compared = _open_baseline(baseline, profile)
    facts: SourceOptions = {"reference": reference, "sensor": profile, "trial": running.get("trial")}
    facts |= {"reference_frame": running.get("reference_frame"), "options": running.get("options")}
    facts |= {"format": running.get("format")}
    chosen = _choose(network, source, select, facts, labels_in_names=labels_in_names, baseline=compared)
    explainers, warnings = choose_explainers(network, chosen, method, budget=budget)
    frames = number_of(len(chosen.ids), "frame")
    title = f"Explaining {frames} ({network.manifest.input}, {chosen.source})"
    bare = replace(chosen, find_markers=None)
    work = Explaining(trained=network, chosen=bare, explainers=explainers, warnings=warnings)
    with reporting(running.get("on_progress")):
        if out is None:
            with open_stage(title):
                return work.make()
        images = hashlib.sha256(chosen.images.numpy().tobytes() + chosen.references.numpy().tobytes())
        recipe = {"weights_sha256": network.manifest.weights_sha256, "input": network.manifest.input}
        recipe |= {"source": chosen.source, "ids": chosen.ids, "images_sha256": images.hexdigest()}
        recipe |= {"method": tuple(explainers), "budget": budget, "baseline": chosen.baseline}
        maps = "a map" if len(explainers) == 1 else number_of(len(explainers), "map")
        what = f"{maps} of {frames if len(chosen.ids) == 1 else f'each of {frames}'}, panel.png"

        def make(parts: Path) -> Explanation:
            overlays = parts.parent / "overlays"
            with open_stage(f"Explaining {frames} into {overlays}"):
                explanation = replace(work, overlays=overlays).make(parts, on=running.get("on", "serial"))
                notes = explanation.methods
                # inside the stage: warnings that differ in numbers alone are then shown once
                for warning in dict.fromkeys(text for each in notes.values() for text in each.warnings):
                    methods = [name for name, each in notes.items() if warning in each.warnings]
                    add_note(f"{', '.join(methods)}: {warning}")
            from sliplens.plots.saliency import draw_explanation  # noqa: PLC0415 (the first map need not wait for it)

            remove(overlays)  # of each map by itself; those of all have one scale
            draw_explanation(explanation, parts.parent)
            return explanation

        overwrite = running.get("overwrite", False)
        keep_record(Path(out), make, stage="explain", config=recipe, what=what, overwrite=overwrite)
    return load_explanation(Path(out))


def _choose(
    network: Network,
    source: Dataset | Recording | Path | str | Images,
    select: FrameSelection | None,
    facts: SourceOptions,
    *,
    labels_in_names: bool,
    baseline: Baseline | None,
) -> ChosenFrames:
    if isinstance(source, str | Path) and (Path(source) / DATASET_FILE).is_file():
        source = load_dataset(source)
    if isinstance(source, Dataset):
        trial = facts.pop("trial")
        if superfluous := [name for name, fact in facts.items() if fact is not None]:
            raise InputError(f"the trials of a data set bring their own facts; leave out {option_flags(superfluous)}")
        selection = select or FrameSelection()
        if trial is not None:
            info = source.find(trial)
            source = replace(source, trials=(info,))
            selection = replace(selection, split=info.split, condition=info.condition)
        return choosing.frames_from_dataset(
            network, source, selection, baseline="stick" if baseline is None else baseline
        )
    if isinstance(source, str | Path | Recording):
        return choosing.frames_from_folder(network, source, labels_in_names=labels_in_names, baseline=baseline, **facts)
    (opened,) = open_source(source, **facts)
    untouched = None if opened.read_reference is None else opened.read_reference()
    frames = np.stack([*opened.read_frames()])
    baseline = "untouched" if baseline is None else baseline
    return choosing.frames_from_arrays(network, frames, untouched, baseline=baseline)


def _open_baseline(baseline: Baseline | Images | Path | str | None, profile: SensorProfile | None) -> Baseline | None:
    """Read the image of a baseline, and fit it to the network's sensor by its profile."""
    if baseline is None or (isinstance(baseline, str) and baseline in BASELINES and baseline != "given"):
        return cast("Baseline | None", baseline)
    if isinstance(baseline, str | Path) and not Path(baseline).is_file():
        raise InputError(
            f"the baseline {baseline} is no image; give untouched, stick, black, mean, blurred, or the path of an image"
        )
    image = read_reference(baseline, what="baseline")
    return image if profile is None else profile.apply(image)


@dataclass(frozen=True, kw_only=True)
class Explaining(Stage[Explanation]):
    """Maps of chosen frames; a part is a method and the number of a batch of frames."""

    record = MethodMaps
    title = "Explaining frames"

    trained: Network
    chosen: ChosenFrames
    explainers: Mapping[str, Explainer]
    warnings: tuple[str, ...] = ()
    overlays: Path | None = None
    """Folder where each map is drawn as soon as it is made; None for nowhere."""

    def prepare(self) -> MakeRecord:
        """Return the function that explains a batch of frames with one method."""
        maps = len(self.chosen.ids) * len(self.explainers)

        def explain_batch(item: tuple[str, int]) -> MethodMaps:
            method, batch = item
            rows = self.chosen.batches[batch]
            with reporting(ignore):  # a whole part counts, not its passes
                overlays = self.overlays and self.overlays / method
                return explain_rows(
                    self.trained, self.chosen, self.explainers[method], rows, maps=maps, overlays=overlays
                )

        return explain_batch

    def parts(self) -> Iterator[Part]:
        """Yield all batches with the first method, then with the next."""
        chosen = self.chosen
        for method in self.explainers:
            for batch, rows in enumerate(chosen.batches):
                first, trial, name = rows[0], chosen.trial[rows[0]], f"{method} of {chosen.ids[rows[0]]}"
                # the folder of the parts is one of these frames and options alone (`files.output_folder`)
                yield part(
                    (method, batch), trial=trial, name=name, recipe=method, content="", first=first, frames=len(rows)
                )

    def join(self, records: Sequence[MethodMaps]) -> Explanation:
        """Make the record of all maps."""
        count = len(self.chosen.batches)
        maps = {method: records[at * count : (at + 1) * count] for at, method in enumerate(self.explainers)}
        return join_maps(self.trained, self.chosen, maps, warnings=self.warnings)


def make_strip(
    network: Network,
    recording: Recording,
    *,
    source: str,
    method: str = RECOMMENDED_METHOD,
    levels: Sequence[float] = MARGIN_LEVELS,
    baseline: Literal["untouched", "stick"] = "stick",
    folder: Path | None = None,
    seed: int = 0,
) -> Strip:
    """Predict every frame of a trial, and explain those nearest to some safety margins in [0, 1].

    `source` is `simulated` or `real`. Without a stick frame the baseline is the untouched sensor. A method by
    marker becomes one by tile where no markers are found. `folder` is that of the simulated data set whose trial it is:
    the last of the frames is then drawn again with markers moved back to the stick frame (`prove_map`, whose random
    markers `seed` draws).
    """
    margin = choosing.require_labels(recording.trial, np.where(recording.labelled, recording.safety_margin, np.nan))
    rows = tuple(sorted({choosing.nearest_frame(margin, level) for level in levels}))
    estimate = network.estimate(network.encode(recording.frames, recording.reference))
    low, high = estimate.interval(0.9) or (np.full(len(margin), np.nan),) * 2
    withheld = estimate.withheld(np.isfinite(margin))
    trusted = np.array([reason is None for reason in withheld])
    pictures, size = recording.frames[list(rows)], network.manifest.image_size
    stick = choosing.find_stick_frame(recording.trial, recording.frames, recording.reference, margin)[0]
    stick = None if baseline == "untouched" else stick
    compared = "untouched" if stick is None else recording.frames[stick]
    chosen = choosing.frames_from_arrays(network, pictures, recording.reference, baseline=compared)
    explainers = study_explainers([method])
    inputs = network.encoding.normalise(chosen.images)
    try:
        explainers = with_markers(
            explainers, inputs, lambda: [markers_in_recording(recording, row, image_size=size) for row in rows]
        )
    except SliplensError:  # another sensor, or no OpenCV
        explainers = without_markers(explainers)
    [(name, maps)] = Explaining(trained=network, chosen=chosen, explainers=explainers).make().relevance.items()
    prediction, low, high = np.where(trusted, np.stack([estimate.margin, low, high]), np.nan).astype(np.float64)
    strip = Strip(
        trial=recording.trial,
        condition=recording.condition,
        source=source,
        input=network.manifest.input,
        method=name,
        readings=StripReadings(
            time_s=recording.time_s.astype(np.float64),
            contact_state=np.array([str(state) for state in recording.contact_state]),
            withheld=np.array([reason or "" for reason in withheld]),
            safety_margin=margin.astype(np.float64),
            prediction=prediction,
            low_90=low,
            high_90=high,
        ),
        shown=rows,
        pictures=pictures,
        relevance=maps,
        baseline="untouched" if stick is None else "stick",
    )
    if folder is None or stick is None:
        return strip
    proof = prove_map(
        network, folder, recording, frame=rows[-1], stick=stick, relevance=maps[-1], rng=np.random.default_rng(seed)
    )
    return strip if proof is None else replace(strip, moved=proof[0], redrawn=proof[1])


RANDOM_SETS = 20
"""Sets of random markers that are moved beside those of a map."""


def prove_map(
    network: Network,
    folder: Path,
    recording: Recording,
    *,
    frame: int,
    stick: int,
    relevance: Float32[np.ndarray, "size size"],
    rng: np.random.Generator,
) -> tuple[MovedMarkers, UInt8[np.ndarray, "1 height width 3"]] | None:
    """Move the fewest markers that hold half of a map's supporting relevance to the stick frame, and predict again.

    `folder` is that of the data set. As many random markers are moved for comparison. The new drawing is returned with
    the record; None where the trial cannot be drawn again, or the map nowhere supports the change of the prediction.
    """
    try:
        film = rebuild_trial(folder, recording)
    except InputError:
        return None
    visible = visible_markers(film.sensor)
    size = network.manifest.image_size
    centres = to_network_px(film.marker_px[frame][visible], recording.frames.shape[1:3], image_size=size)

    def predict(moved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        back = np.zeros((len(moved), len(film.marker_rest_px)), dtype=bool)
        back[:, visible] = moved
        drawn = put_markers_back(film, frame, back, to=stick).draw_all()
        return drawn, network.predict(network.encode(drawn, recording.reference)).cpu().numpy().astype(np.float64)

    count = len(visible)
    _, (now, after_all) = predict(np.stack([np.zeros(count, dtype=bool), np.ones(count, dtype=bool)]))
    sums = marker_sums(relevance, marker_regions((size, size), centres).numpy(), markers=count)
    supporting = np.clip(sums * np.sign(now - after_all), 0, None)
    if supporting.sum() <= 0:
        return None
    order = np.argsort(-supporting, kind="stable")
    few = 1 + int(np.argmax(np.cumsum(supporting[order]) >= 0.5 * supporting.sum()))
    sets = np.stack([order[:few], *(rng.choice(count, few, replace=False) for _ in range(RANDOM_SETS))])
    moved = np.zeros((len(sets), count), dtype=bool)
    np.put_along_axis(moved, sets, values=True, axis=1)
    drawn, after = predict(moved)
    record = MovedMarkers(
        frame=frame,
        prediction=float(now),
        change=float(now - after[0]),
        change_all=float(now - after_all),
        change_random=float(np.mean(now - after[1:])),
        random_sets=RANDOM_SETS,
        markers=count,
        from_px=tuple((float(x), float(y)) for x, y in film.marker_px[frame][visible[order[:few]]]),
    )
    return record, drawn[:1]
