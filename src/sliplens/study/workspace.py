"""Explanations of one network and their deletion scores, as records, and as folders of a workspace."""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from torch import Tensor

from sliplens.codec import load_result, save_result
from sliplens.errors import InputError, SliplensError
from sliplens.explainers.contract import Explainer
from sliplens.explainers.gradients import ExpectedGradients
from sliplens.explainers.occlusion import markers_in_frame, markers_in_recording
from sliplens.explainers.table import EXPLAINERS, RECOMMENDED_METHOD, get_explainer
from sliplens.faithfulness.fills import get_fill
from sliplens.files import output_folder, remove
from sliplens.images import write_png
from sliplens.models import Network
from sliplens.models.checkpoint import open_run
from sliplens.plots.saliency import SIGN_COLOURS, draw_panel, full_colour, overlay_jet, overlay_relevance
from sliplens.plots.style import drawing_style, method_name, percent, reading_words
from sliplens.progress import OnProgress, note, number_of, stage, wrote
from sliplens.recordings import Dataset, Recording
from sliplens.recordings.capture import Capture
from sliplens.recordings.sensor import SensorProfile, load_profile
from sliplens.recordings.source import open_source
from sliplens.results.explanation import Explanation, Strip, StripReadings, load_explanation
from sliplens.results.faithfulness import DeletionScores
from sliplens.study.choice import STUDY_BUDGET, study_explainers, with_markers, without_markers
from sliplens.study.explaining import (
    DEFAULT_LEVELS,
    ChosenFrames,
    OnMap,
    explain_frames,
    frames_from_dataset,
    frames_from_folder,
    known_margin,
    nearest_frame,
    require_methods,
)
from sliplens.study.scoring import Deletion, require_same_network

_FULL_STICK = 0.9
"""Safety margin from which a labelled frame counts as one without slip."""


def explain_source(
    run: Network | Path | str,
    source: Dataset | Path,
    *,
    reference: Path | None = None,
    labels_in_names: bool = False,
    sensor: SensorProfile | Path | str | None = None,
    methods: Sequence[str] | None = None,
    budget: float | None = None,
    split: str = "test",
    condition: str = "dry",
    trials: int = 1,
    levels: Sequence[float] = DEFAULT_LEVELS,
    device: str = "cpu",
    on: str = "serial",
    retry_failed: bool = False,
    out: Path | None = None,
    colours: Literal["signed", "jet"] = "signed",
    overwrite: bool = False,
    on_progress: OnProgress | None = None,
) -> Explanation:
    """Explain frames of a data set along the safety margin, or all frames of a folder or recording.

    Parameters
    ----------
    source, reference
        A data set; or a folder of images, or a recording: camera frames if an image of the untouched sensor is given
        or the recording brings one, else absolute difference images.
    labels_in_names
        Read the safety margin in percent from names of images such as `image_433_20.png`.
    sensor
        Profile of the sensor, its file, or the name of one that comes with sliplens; None for a data set.
    methods, budget
        Rows of `EXPLAINERS`, and the share of the channels that `poly-cam` measures at first. If None, Shapley values
        of the markers (`RECOMMENDED_METHOD`), or of tiles where no markers are found; and all channels for a single
        image, a part of them for several.
    split, condition, trials, levels
        Which trials of a data set and how many, and the safety margins at which frames are taken.
    on, retry_failed
        Where maps are made, a row of `runner.EXECUTORS`: `serial`, `processes`, `processes=4`; and whether those are
        tried again that failed three times before.
    out
        Folder to write: maps, overlays of every map, all of them side by side; nowhere if None. A folder that was
        interrupted goes on after its last map.
    colours
        Colours of the overlays: what raises the answer and what lowers it, on one scale for all frames; or what
        supports it, each frame on a scale of its own, as the thesis's figures have it.

    Raises
    ------
    InputError
        If there is no such method, the source has no such frames, or the folder holds something else.
    PartError
        If some of many maps failed again and again, when all others are there.
    """
    require_methods(methods or ())
    out = None if out is None else Path(out)
    if trials < 1:
        raise InputError(f"--trials must be at least 1, got {trials}")
    trained = open_run(run, device=device)
    if isinstance(source, Dataset):
        if sensor is not None:
            raise InputError("a data set's frames went through their profile on import; leave out --sensor")
        chosen = frames_from_dataset(
            trained, source, split=split, condition=condition, trials=trials, levels=tuple(levels)
        )
    else:
        sensor = None if sensor is None else load_profile(sensor)
        chosen = frames_from_folder(
            trained, source, reference=reference, labels_in_names=labels_in_names, sensor=sensor
        )
    opened = source if isinstance(source, Dataset) else partial(open_source, source, reference=reference, sensor=sensor)
    budget = budget if budget is not None else 1.0 if len(chosen.ids) == 1 else STUDY_BUDGET
    choose = partial(_choose_explainers, trained, chosen, opened, budget=budget)
    if methods is None:
        try:
            explainers = choose(methods=[RECOMMENDED_METHOD])
        except SliplensError as error:  # difference images, another sensor, or no OpenCV: tiles tell nearly as much
            note(on_progress, f"tiles, not markers: {error}")
            explainers = choose(methods=[RECOMMENDED_METHOD.removesuffix("-marker")])
        methods = tuple(explainers)
    else:
        explainers = choose(methods=methods)
    rows: dict[str, Any] = {"methods": methods, "explainers": explainers, "on": on, "retry_failed": retry_failed}
    explain = partial(explain_frames, trained, chosen, **rows)
    frames = number_of(len(chosen.ids), "frame")
    title = f"Explaining {frames} ({trained.manifest.input}, {chosen.source})"
    if out is None:
        with stage(on_progress, title) as count:
            return explain(on_progress=count)
    images = hashlib.sha256(chosen.images.numpy().tobytes())
    images.update(chosen.references.numpy().tobytes())
    recipe: dict[str, Any] = {"weights_sha256": trained.manifest.weights_sha256, "input": trained.manifest.input}
    recipe |= {"source": chosen.source, "ids": chosen.ids, "images_sha256": images.hexdigest()}
    recipe |= {"method": tuple(methods), "budget": budget, "colours": colours}
    maps = "a map" if len(methods) == 1 else number_of(len(methods), "map")
    what = f"{maps} of {frames if len(chosen.ids) == 1 else f'each of {frames}'}, panel.png"
    with output_folder(out, stage="explain", config=recipe, overwrite=overwrite) as output:
        if not output.complete:
            with stage(on_progress, title) as count:
                show = _show_first(output.folder, chosen.ids, on_progress) if colours == "signed" else None
                explained = explain(parts=output.folder / "parts", on_map=show, on_progress=count)
                # while the stage is open: what differs in numbers alone is then shown once
                for warning in dict.fromkeys(
                    warning for notes in explained.methods.values() for warning in notes.warnings
                ):
                    warned = [method for method, notes in explained.methods.items() if warning in notes.warnings]
                    note(on_progress, f"{', '.join(warned)}: {warning}")
            draw_explained(explained, output.folder, colours=colours)
            save_result(explained, output.folder)
            remove(output.folder / "parts")  # not before: what fails above goes on from them
            del explained  # it is read once more, and is large
    wrote(on_progress, out, what, kept=output.complete)
    return load_explanation(out)


def score_explained(
    run: Network | Path | str,
    explanations: Explanation | Path,
    *,
    fill: str = "grey",
    steps: int | None = None,
    seed: int = 0,
    device: str = "cpu",
    on: str = "serial",
    retry_failed: bool = False,
    out: Path | None = None,
    overwrite: bool = False,
    on_progress: OnProgress | None = None,
) -> DeletionScores:
    """Score explanations by deletion, as the thesis does, beside a random order.

    `run` is the network that was explained, `fill` a row of `FILLS`; as in the thesis every pixel is gone after as many
    steps as the image is high if `steps` is None. Curves and scores are written to the folder `out`, if it is named;
    interrupted, it goes on after the last trial. `on` says where trials are scored, a row of `runner.EXECUTORS`:
    `serial`, `processes`, `processes=4`; `retry_failed` tries those again that failed three times before.

    Raises
    ------
    InputError
        If there is no such fill or folder, or the folder to write holds something else.
    CheckpointError
        If the explanations are of another network.
    PartError
        If some of several trials failed again and again, when all others are there.
    """
    get_fill(fill)
    trained = open_run(run, device=device)
    explained = explanations if isinstance(explanations, Explanation) else load_explanation(explanations)
    require_same_network(trained, explained)
    title = f"Deleting pixels ({explained.input}, {explained.source})"
    work = Deletion(trained=trained, explained=explained, fill=fill, steps=steps, seed=seed)
    score = partial(work.make, on=on, retry_failed=retry_failed)
    if out is None:
        with stage(on_progress, title) as count:
            return score(on_progress=count)
    maps = hashlib.sha256()
    for rows in explained.saliency.values():
        maps.update(rows.tobytes())
    recipe: dict[str, Any] = {"weights_sha256": trained.manifest.weights_sha256, "maps_sha256": maps.hexdigest()}
    recipe |= {"input": explained.input, "source": explained.source, "fill": fill, "steps": steps, "seed": seed}
    with output_folder(out, stage="score", config=recipe, overwrite=overwrite) as output:
        if not output.complete:
            with stage(on_progress, title) as count:
                scores = score(parts=output.folder / "parts", on_progress=count)
            save_result(scores, output.folder)
            remove(output.folder / "parts")
    wrote(on_progress, out, "curves and scores", kept=output.complete)
    return load_result(out, DeletionScores, command="sliplens score")


_WIDEST = 12
"""Frames of a panel at most, which can still be seen on a screen."""


def draw_explained(explained: Explanation, folder: Path, *, colours: Literal["signed", "jet"]) -> None:
    """Write an overlay of every map (`overlays/METHOD/FRAME.png`), and of a few frames all side by side (`panel.png`).

    These are all frames, or of many `_WIDEST`, spread evenly over them in their order.
    """
    count = len(explained.frames)
    columns = np.linspace(0, count - 1, min(count, _WIDEST)).round().astype(int).tolist()
    rows = {"What the network saw": [explained.pictures[column] for column in columns]}
    for method, maps in explained.saliency.items():
        (overlays := folder / "overlays" / method).mkdir(parents=True, exist_ok=True)
        points = _points(explained.relevance[method])
        limit = _common_scale(points)
        scale = f"\nfull colour: {limit:.2g} points" if colours == "signed" else ""
        row = []
        for frame, picture, saliency, signed in zip(explained.frames, explained.pictures, maps, points, strict=True):
            # a map that holds NaN is named in the notes, and is not shown
            finite = bool(np.isfinite(signed).all())
            lay = overlay_jet(picture, saliency) if colours == "jet" and finite else None
            row.append(overlay_relevance(picture, signed / limit) if colours == "signed" and finite else lay)
            if row[-1] is not None:
                write_png(overlays / f"{frame.id}.png", row[-1])
        rows[f"{method_name(method)}{scale}"] = [row[column] for column in columns]
    titles = [
        # of recorded images the margin need not be known
        f"{_short(frame.id)}\n{reading_words(frame.prediction, frame.withheld)}"
        + ("" if frame.safety_margin is None else f", true {percent(frame.safety_margin)}")
        for frame in (explained.frames[column] for column in columns)
    ]
    if colours == "jet":
        bar, words = (
            ScalarMappable(Normalize(0, 1), "jet"),
            "supports the answer (share of its own picture's strongest)",
        )
    else:
        bar = ScalarMappable(Normalize(-1, 1), SIGN_COLOURS)
        words = "lowers the margin  |  raises it, in shares of the full colour\n"
        words += "(which is in points of margin per 1 % of the image)"
    if len(columns) < count:
        words += f"\n{len(columns)} of {count} frames, evenly spread; overlays/ has them all"
    with drawing_style():
        draw_panel(rows, titles=titles, bar=bar, bar_label=words).savefig(folder / "panel.png", bbox_inches="tight")


_LEAST = 0.2
"""Full colour at least, in points of margin per 1 % of the image: 2 points, which is nothing to explain, on a tenth."""


def _points(relevance: Float32[np.ndarray, "*frames height width"]) -> Float32[np.ndarray, "*frames height width"]:
    """Relevance in points of the margin for every 1 % of the image: its own unit is too small to read."""
    return relevance * (relevance.shape[-1] * relevance.shape[-2])


def _common_scale(points: Float32[np.ndarray, "frames height width"]) -> float:
    """Full colour of all frames of a method, so that one with nothing to explain looks empty."""
    finite = points[np.isfinite(points).all(axis=(1, 2))]
    return max(full_colour(finite), _LEAST) if len(finite) else _LEAST


def _short(name: str) -> str:
    return name if len(name) <= 22 else f"\N{HORIZONTAL ELLIPSIS}{name[-21:]}"


def _show_first(folder: Path, ids: Sequence[str], on_progress: OnProgress | None) -> OnMap:
    """Draw the first map as soon as it is there, on a scale of its own: something to look at while others are made."""
    chosen = []

    def show(
        method: str,
        index: int,
        picture: UInt8[np.ndarray, "height width 3"],
        relevance: Float32[np.ndarray, "height width"],
    ) -> None:
        if chosen or not np.isfinite(relevance).all():
            return
        path = folder / "overlays" / method / f"{ids[index]}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        points = _points(relevance)
        write_png(path, overlay_relevance(picture, points / _common_scale(points[None])))
        chosen.append(path)
        wrote(on_progress, path, "a first picture; the folder takes its name when all are there")

    return show


def _choose_explainers(
    trained: Network,
    chosen: ChosenFrames,
    source: Dataset | Callable[[], Sequence[Capture]],
    *,
    methods: Sequence[str],
    budget: float,
) -> Mapping[str, Explainer]:
    """The explainers with the options that these frames allow."""
    free = [index for index, margin in enumerate(chosen.safety_margin) if margin >= _FULL_STICK]
    background = trained.encoding.normalise(chosen.images[free]) if free else None
    rows: dict[str, Explainer] = {"expected-gradients": ExpectedGradients(background=background)}
    rows["poly-cam"], inputs = get_explainer("poly-cam", budget=budget), trained.encoding.normalise(chosen.images)
    names_used = {name: rows.get(name) or EXPLAINERS[name] for name in methods}
    return with_markers(names_used, inputs, lambda: _find_markers(trained, chosen, source))


def _find_markers(
    trained: Network, chosen: ChosenFrames, source: Dataset | Callable[[], Sequence[Capture]]
) -> list[Float[Tensor, "_markers 2"]]:
    """Places of the markers, frame by frame: where the simulator put them, else where they are found."""
    size = trained.manifest.image_size
    if isinstance(source, Dataset):
        opened = {info.trial: source.load(info) for info in source.trials if info.trial in chosen.trial}
        return [
            markers_in_recording(opened[trial], int(name.removeprefix(f"{trial}-f")), image_size=size)
            for name, trial in zip(chosen.ids, chosen.trial, strict=True)
        ]
    opened_trials = source()
    if any(trial.read_reference is None for trial in opened_trials):
        raise InputError(
            "markers are found in camera frames, which difference images are not; give camera frames and --reference, "
            "or a data set"
        )
    return [markers_in_frame(frame, image_size=size) for trial in opened_trials for frame in trial.read_frames()]


_CONFIDENCE = 0.9


def explain_trial(
    run: Network,
    recording: Recording,
    *,
    source: str,
    method: str = RECOMMENDED_METHOD,
    levels: Sequence[float] = DEFAULT_LEVELS,
    on_progress: OnProgress | None = None,
) -> Strip:
    """Read every frame of a trial, and explain those nearest to a few safety margins.

    The frames are those nearest to `levels` in [0, 1], each shown once; `source` is `simulated` or `real`. Where a
    method asks for markers and none are found, it is told of tiles.
    """
    margin = known_margin(recording.trial, np.where(recording.labelled, recording.safety_margin, np.nan))
    chosen = tuple(sorted({nearest_frame(margin, level) for level in levels}))
    inputs = run.encode(recording.frames, recording.reference)
    estimate = run.estimate(inputs)
    unknown = np.full(len(margin), np.nan)
    low, high = estimate.interval(_CONFIDENCE) or (unknown, unknown)
    withheld = estimate.withheld(np.isfinite(margin))
    believed = np.array([reason is None for reason in withheld])
    names_used, explained, size = study_explainers([method]), inputs[list(chosen)], run.manifest.image_size
    reference = run.encoding.empty(recording.reference, image_size=size)
    try:
        names_used = with_markers(
            names_used, explained, lambda: [markers_in_recording(recording, row, image_size=size) for row in chosen]
        )
    except SliplensError:  # another sensor, or no OpenCV
        names_used = without_markers(names_used)
    [(method, explainer)] = names_used.items()
    explanation = explainer(
        run.model, explained, reference=reference.expand(len(chosen), -1, -1, -1), on_progress=on_progress
    )
    read = {"prediction": estimate.margin, "low": low, "high": high}
    read = {name: np.where(believed, values, np.nan) for name, values in read.items()} | {"safety_margin": margin}
    readings = StripReadings(
        time_s=recording.time_s.astype(np.float64),
        contact_state=np.array([str(state) for state in recording.contact_state]),
        withheld=np.array([reason or "" for reason in withheld]),
        **{name: values.astype(np.float64) for name, values in read.items()},
    )
    maps, pictures = explanation.relevance.to(torch.float32).cpu().numpy(), recording.frames[list(chosen)]
    of_trial = {"trial": recording.trial, "condition": recording.condition, "source": source, "method": method}
    rows: dict[str, Any] = {"readings": readings, "shown": chosen, "pictures": pictures, "relevance": maps}
    return Strip(**of_trial, input=run.manifest.input, **rows)
