"""Public call that scores explanations, its two stages, and maps of networks with new weights."""

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations, product
from pathlib import Path
from typing import Literal, TypeAlias, Unpack

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from sliplens.codec import load_result
from sliplens.errors import InputError, ModelError, SaliencyError
from sliplens.explainers.contract import Explainer
from sliplens.explainers.explain import join_maps, network_inputs, network_references
from sliplens.explainers.frames import frames_from_arrays
from sliplens.explainers.gradients import IntegratedGradients
from sliplens.explainers.occlusion import tile_regions
from sliplens.explainers.poly_cam import PolyCam
from sliplens.explainers.shapley import Shapley
from sliplens.extras import require_keywords
from sliplens.faithfulness import controls, scoring
from sliplens.faithfulness.fills import get_fill
from sliplens.faithfulness.removal import AREAS, RANDOM_ORDERS, SHARES, Units, score_maps
from sliplens.images import Images, as_frames
from sliplens.intervals import paired_difference
from sliplens.models import Network
from sliplens.models.wrapping import open_run
from sliplens.progress import open_stage, report_each, reporting
from sliplens.recordings.source import read_reference
from sliplens.results.explanation import Explanation, MethodNotes, load_explanation, require_saliency
from sliplens.results.faithfulness import CHANCE, NEW_WEIGHTS, DeletionScores, Faithfulness, MethodGap, RemovalCurve
from sliplens.results.study import REDRAWN, SETTINGS, MapMeasures, MapQuality, MarkerTable, Setting, UntrainedMaps
from sliplens.runner import Part, keep_record
from sliplens.study.choice import network_places, trial_seed
from sliplens.study.explaining import Running
from sliplens.study.stages import MakeRecord, Result, Stage, TrialArrays, join_trials, mean_of_known, trial_parts

STEPS = 28
"""An eighth of the thesis's 224: the mean over the steps differs from that over all of them by less than a step."""
STUDY_AREAS = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.4, 0.7, 1.0)
"""Fewer shares than `AREAS`, so that many settings can be scored: enough for trapezoids."""
STUDY_ORDERS = 10
"""Random orders that every method of a study has to beat."""
Influence: TypeAlias = Mapping[str, controls.Maps]
"""Maps that rank parts, of each method and control."""
Maps: TypeAlias = Float[np.ndarray, "maps rows columns"] | Float[Tensor, "maps rows columns"] | Path | str


def score(
    run: Network | nn.Module | Path | str,
    frames: Images | Explanation | Path | str,
    maps: Explanation | Maps | None = None,
    *,
    reference: Path | str | Images | None = None,
    signed: bool = True,
    fill: str = "reference",
    unit: Literal["pixel", "tile"] = "pixel",
    random_orders: int = RANDOM_ORDERS,
    steps: int = STEPS,
    seed: int = 0,
    out: Path | str | None = None,
    **running: Unpack[Running],
) -> Faithfulness:
    """Score maps by removing the most influential pixels first, and last, against random orders and controls.

    The score is the symmetric gain, in margin units: how much further the prediction moves towards that of the
    baseline with the most influential parts removed first rather than the least. Maps that gain no more than
    the controls, which use nothing the network learned, show nothing. Every frame counts; an alarm names how many are
    predicted nearly like the baseline, which a study leaves out (`worth_scoring`). The record also holds the
    deletion score of the thesis, under its grey fill, to compare with published figures (docs/deletion.md).

    Parameters
    ----------
    run
        The network that was explained, its folder, the name of one that comes with sliplens, or the PyTorch module.
    frames, reference
        Explanation, or the folder of one, which holds its frames; or the frames and the reference of `explain`.
    maps
        Explanation of the frames, or its folder; or an array or tensor (frames, size, size) of one number a pixel of
        the network's input, by another tool. None where `frames` is an explanation.
    signed
        Meaning of an array. If True, above zero where a pixel raises the prediction, as `Explanation.relevance` and the
        attributions of Captum, summed over the colours. Pixels then rank by sign(f(x) - f(reference)) times the map,
        as those of an `Explanation` do. If False, larger where a pixel matters more, whichever way the prediction went,
        as a saliency in [0, 1].
    fill
        Content of removed pixels (docs/deletion.md); `reference`, the baseline of the explanation, is one that
        networks know.
    unit
        What is removed at once: pixels, or square tiles of a fourteenth of the image.
    random_orders
        Number of random orders.
    steps
        Steps of the deletion score until every pixel is removed; 224 as in the thesis, 0 to leave it out.
    seed
        Seed of the random orders.
    out
        Folder to write; nothing is written if None. An interrupted call continues after the last trial.
    running
        Options of `Running`.

    Raises
    ------
    InputError
        If there is no such fill, the network needs a reference, or the folder to write holds something else.
    CheckpointError
        If the explanation is of another network.
    SaliencyError
        If there is not a map a frame, or one has another size than the network's input, or holds NaN; or if a signed
        array has no number below zero for a frame whose prediction fell.
    PartError
        If some of several trials failed three times, when all others are done.

    See Also
    --------
    explain : Make maps.
    run_study : Compare methods on a data set.

    Examples
    --------
    >>> import sliplens as sl
    >>> maps = sl.explain("chromatouch-pair", "cup.mp4", reference="untouched.png")  # doctest: +SKIP
    >>> score = sl.score("chromatouch-pair", maps).scores[0]  # doctest: +SKIP
    >>> score.method, round(score.srg.estimate, 2), score.lead_over_controls.control  # doctest: +SKIP
    ('shapley-marker', 0.81, 'change')
    """
    require_keywords(score, running)
    get_fill(fill)
    if random_orders < 1:
        raise InputError(f"{random_orders} random orders are too few; --random-orders must be at least 1")
    network = open_run(run, device=running.get("device", "cpu"), preprocess=running.get("preprocess"))
    explanation = _to_score(network, frames, maps, reference, signed=signed)
    scoring.require_same_network(network, explanation)
    shape = (explanation.image_size, explanation.image_size)
    units = tile_regions(shape, tile_px=1 if unit == "pixel" else max(1, shape[0] // 14)).numpy()
    removal = Removal(
        trained=network,
        explained=explanation,
        maps=scoring.influences(network, explanation),
        units={unit: [units] * len(explanation.frames)},
        settings=(Setting(fill=fill, unit=unit),),
        areas=AREAS,
        random_orders=random_orders,
        seed=seed,
    )

    def make_stage(stage: Stage[Result], folder: Path | None) -> Result:
        with open_stage(stage.title):
            return stage.make(folder and folder / type(stage).__name__, on=running.get("on", "serial"))

    def make(folder: Path | None) -> Faithfulness:
        scores = make_stage(removal, folder)
        if not steps:
            return scores
        deletion = PixelDeletion(trained=network, explained=explanation, steps=steps, seed=seed)
        return scores.with_deletion(make_stage(deletion, folder))

    with reporting(running.get("on_progress")):
        if out is None:
            return make(None)
        maps_sha256 = hashlib.sha256(
            b"".join(values.tobytes() for values in explanation.relevance.values())
        ).hexdigest()
        config = {"weights_sha256": network.manifest.weights_sha256, "maps_sha256": maps_sha256}
        config |= {"input": explanation.input, "source": explanation.source, "seed": seed, "steps": steps}
        config |= {"fill": fill, "unit": unit, "random_orders": random_orders}
        overwrite = running.get("overwrite", False)
        what = "curves and scores"
        keep_record(Path(out), make, stage="faithfulness", config=config, what=what, overwrite=overwrite)
    return load_result(Path(out), Faithfulness, command="sliplens score")


def _to_score(
    network: Network,
    frames: Images | Explanation | Path | str,
    maps: Explanation | Maps | None,
    reference: Path | str | Images | None,
    *,
    signed: bool,
) -> Explanation:
    """Return the explanation to score, or make the record of maps that another tool computed."""
    if isinstance(frames, Explanation):
        return frames
    if isinstance(frames, str | Path):
        return load_explanation(Path(frames))
    if maps is None:
        raise InputError("the frames have no maps to score; give an explanation of them, or an array of maps")
    if isinstance(maps, Path | str):
        maps = load_explanation(Path(maps))
    if isinstance(maps, Tensor):
        maps = maps.detach().cpu().numpy()
    frames = as_frames(frames)
    count = len(maps if isinstance(maps, np.ndarray) else maps.frames)
    if count != len(frames):
        raise SaliencyError(f"there are {count} maps of {len(frames)} frames; explain the frames that are scored")
    if not isinstance(maps, np.ndarray):
        return maps
    untouched = None if reference is None else read_reference(reference)
    explanation = join_maps(network, frames_from_arrays(network, frames, untouched), {})
    for index, values in enumerate(maps):
        require_saliency(values, explanation.images.shape[-2:], where=f"map {index}")
    positive = (maps.min(axis=(1, 2)) >= 0) & (maps.max(axis=(1, 2)) > 0)
    for index in np.flatnonzero((explanation.towards < 0) & positive) if signed else ():
        raise SaliencyError(
            f"map {index} has no number below 0, but the prediction of its frame is lower than that of the untouched "
            "sensor, which a signed map must explain by pixels that lower it; if its numbers say how much a pixel "
            "matters whichever way, give signed=False"
        )
    notes = MethodNotes(seconds_per_frame=0.0, warnings=(), raises_only=not signed)
    return replace(explanation, methods={"maps": notes}, relevance={"maps": maps.astype(np.float32)})


@dataclass(frozen=True, kw_only=True)
class Removal(Stage[Faithfulness]):
    """Removal of parts in the order of every map, under each setting; a part is a setting and a trial."""

    record = TrialArrays
    title = "Removing parts"

    trained: Network
    explained: Explanation
    maps: Influence
    """Maps of the methods and controls (`influences`)."""
    units: Mapping[str, Sequence[Units]]
    """Units of each frame by name; settings of others are left out."""
    settings: Sequence[Setting] = SETTINGS
    areas: Sequence[float] = STUDY_AREAS
    random_orders: int = RANDOM_ORDERS
    redraw: Callable[[Explanation, Influence, int], Mapping[str, RemovalCurve]] | None = None
    """Curves under the true fill, by drawing the scene again; None where it cannot be."""
    seed: int = 0

    @property
    def _all_settings(self) -> list[Setting]:
        settings = [setting for setting in self.settings if setting.unit in self.units]
        return settings if self.redraw is None else [*settings, REDRAWN]

    def parts(self) -> Iterator[Part]:
        """Yield all trials under the first setting, then under the next."""
        for setting in self._all_settings:
            yield from trial_parts(self.explained, setting.fill, setting.unit)

    def prepare(self) -> MakeRecord:
        """Return the function that computes the curves of a trial under one setting."""
        inputs, orders = network_inputs(self.trained, self.explained), 2 * len(self.maps) + self.random_orders
        references = network_references(self.trained, self.explained)
        passes = len(self.settings) * len(inputs) * orders * (len(self.areas) - 2)
        predict, trials = scoring.prepare_passes(self.trained, inputs, passes), list(self.explained.trials)

        def remove_parts(item: tuple[str, str, str]) -> TrialArrays:
            fill, unit, trial = item
            setting, rows = Setting(fill=fill, unit=unit), self.explained.trials[trial]
            part, maps = self.explained.take(rows), {name: values[rows] for name, values in self.maps.items()}
            images, empty, seed = inputs[rows], references[rows], trial_seed(self.seed, trials.index(trial))
            if setting == REDRAWN and self.redraw is not None:
                curves = self.redraw(part, maps, seed)
            else:
                curves = score_maps(
                    predict,
                    images,
                    maps,
                    [self.units[unit][row] for row in rows],
                    fill=get_fill(fill),
                    references=empty,
                    towards=part.towards,
                    # the same random orders under every fill
                    rng=np.random.default_rng(seed),
                    random_orders=self.random_orders,
                    areas=self.areas,
                    seed=seed,
                )
            return TrialArrays(
                arrays={
                    name: np.stack([curve.most_first, curve.least_first, curve.random], axis=1)
                    for name, curve in curves.items()
                }
            )

        return remove_parts

    def join(self, records: Sequence[TrialArrays]) -> Faithfulness:
        """Score all curves."""
        count, curves = len(self.explained.trials), {}
        for at, setting in enumerate(self._all_settings):
            areas = np.array(SHARES if setting == REDRAWN else self.areas)
            arrays = join_trials(self.explained, records[at * count : (at + 1) * count])
            curves[setting] = {
                name: RemovalCurve(areas=areas, most_first=rows[:, 0], least_first=rows[:, 1], random=rows[:, 2])
                for name, rows in arrays.items()
            }
        return scoring.score_curves(self.explained, curves, random_orders=self.random_orders, seed=self.seed)


@dataclass(frozen=True, kw_only=True)
class PixelDeletion(Stage[DeletionScores]):
    """Deletion of the most salient pixels by every method and in a random order; a part is a trial."""

    record = TrialArrays
    title = "Deleting pixels, as the thesis did"

    trained: Network
    explained: Explanation
    fill: str = "grey"
    steps: int | None = None
    """The image's height if None."""
    seed: int = 0

    def parts(self) -> Iterator[Part]:
        """Yield the trials, whose maps are counted with a random one."""
        return trial_parts(self.explained, maps=len(self.explained.relevance) + 1)

    def prepare(self) -> MakeRecord:
        """Return the function that deletes the pixels of the frames of a trial."""
        inputs, size = network_inputs(self.trained, self.explained), self.explained.image_size
        rng, saliency = np.random.default_rng(self.seed), self.explained.saliency
        orders = {name: np.stack(list(map(scoring.deletion_order, maps))) for name, maps in saliency.items()}
        orders[CHANCE] = np.stack([rng.permutation(size**2) for _ in self.explained.frames])
        removed = scoring.deletion_steps((size, size), steps=self.steps)
        predict = scoring.prepare_passes(self.trained, inputs, len(orders) * len(inputs) * len(removed))

        def delete(item: tuple[str]) -> TrialArrays:
            rows = self.explained.trials[item[-1]]
            answers = {
                name: scoring.delete_pixels(predict, inputs[rows], orders[name][rows], fill=self.fill, steps=self.steps)
                for name in report_each(list(orders), sizes=[len(rows)] * len(orders))
            }
            return TrialArrays(arrays=answers)

        return delete

    def join(self, records: Sequence[TrialArrays]) -> DeletionScores:
        """Score all curves."""
        return scoring.score_deletion(self.explained, join_trials(self.explained, records), fill=self.fill)


_FEW_FRAMES = 2  # on which infidelity and sensitivity are measured


def measure_maps(
    trained: Network,
    explained: Explanation,
    explainers: Mapping[str, Explainer],
    markers: Mapping[str, MarkerTable],
    *,
    seed: int = 0,
) -> MapQuality:
    """Measure resolution, smoothness, infidelity and sensitivity of the maps, and compare the methods' smoothness."""
    rng, model = np.random.default_rng(seed), trained.model
    few, compared = (of(trained, explained)[:_FEW_FRAMES] for of in (network_inputs, network_references))
    measures, roughness = {}, {}
    for method in report_each(list(explainers)):
        maps = explained.saliency[method].astype(np.float64)
        resolutions = [
            controls.resolution(saliency, network_places(markers[frame.id], trained.manifest)[0])
            for saliency, frame in zip(maps, explained.frames, strict=True)
            if frame.id in markers
        ]
        roughness[method] = np.array([controls.total_variation(saliency) for saliency in maps])
        explainer = _shortened(explainers[method])

        def explain(images: Tensor, explainer: Explainer = explainer) -> Tensor:
            references = compared.repeat_interleave(len(images) // len(compared), dim=0)
            return explainer(model, images, reference=references).relevance

        relevance = torch.from_numpy(explained.relevance[method][:_FEW_FRAMES])
        errors = controls.infidelity(lambda images: model(images).flatten(), few, compared, relevance)
        measures[method] = MapMeasures(
            resolution=mean_of_known(np.array(resolutions, dtype=np.float64)),
            total_variation=mean_of_known(roughness[method]),
            infidelity=mean_of_known(errors),
            max_sensitivity=mean_of_known(controls.max_sensitivity(explain, few)),
        )
    return MapQuality(
        input=explained.input,
        source=explained.source,
        frames=len(explained.frames),
        methods=measures,
        comparisons=tuple(
            MethodGap(
                first=first,
                second=second,
                gap=paired_difference(roughness[first], roughness[second], clusters=explained.clusters, rng=rng),
            )
            for first, second in combinations(roughness, 2)
        ),
    )


def _shortened(explainer: Explainer) -> Explainer:
    """Spare passes that a map of new weights does not need: few channels or pairs, no checks."""
    if isinstance(explainer, PolyCam):
        return replace(explainer, likeness=None, budget=min(explainer.budget, 0.05))
    if isinstance(explainer, IntegratedGradients):
        return replace(explainer, max_steps=explainer.steps)
    return replace(explainer, pairs=100) if isinstance(explainer, Shapley) else explainer


@dataclass(frozen=True, kw_only=True)
class Untrained(Stage[UntrainedMaps]):
    """Maps of networks with all weights drawn again by each method: controls that every map has to beat.

    Each trial, a part, has a network of its own, so that resampled trials tell what the draw of the weights matters
    too. Poly-CAM measures 5 % of the channels here and has no likeness, Shapley values draw 100 pairs of coalitions.
    """

    record = TrialArrays
    title = "Explaining networks with new weights"

    trained: Network
    explained: Explanation
    explainers: Mapping[str, Explainer]
    """By name, with the markers of the frames."""
    seed: int = 0

    def parts(self) -> Iterator[Part]:
        """Yield the trials, whose maps are counted."""
        return trial_parts(self.explained, maps=len(self.explainers))

    def prepare(self) -> MakeRecord:
        """Return the function that explains the frames of a trial with its network."""
        inputs, references = (of(self.trained, self.explained) for of in (network_inputs, network_references))
        shortened = {name: _shortened(explainer) for name, explainer in self.explainers.items()}
        trials = self.explained.trials

        def explain(item: tuple[str]) -> TrialArrays:
            frames, seed = trials[item[-1]], trial_seed(self.seed, list(trials).index(item[-1]))
            ((_, model),) = controls.cascade(self.trained.model, seed=seed, stages=1, images=inputs)
            maps: dict[str, list[np.ndarray]] = {}
            with suppress(ModelError):  # without layers that have a map
                even = controls.even_channels(model, inputs[frames], references[frames])
                maps["weights-1"] = list(even.cpu().numpy())
            for name, frame in report_each(list(product(shortened, frames))):
                attribution = shortened[name](model, inputs[frame, None], reference=references[frame, None])
                maps.setdefault(name, []).append(attribution.influence[0].float().cpu().numpy())
            return TrialArrays(arrays={name + NEW_WEIGHTS: np.stack(rows) for name, rows in maps.items()})

        return explain

    def join(self, records: Sequence[TrialArrays]) -> UntrainedMaps:
        """Join the maps of all frames."""
        maps = join_trials(self.explained, records)
        return UntrainedMaps(input=self.explained.input, source=self.explained.source, maps=maps)
