"""Explanations held against the truth that only a simulator knows: what each marker does when it is put back."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float64, Int, Shaped, UInt8
from scipy.stats import spearmanr
from torch import Tensor

from sliplens.codec import keep_part
from sliplens.errors import InputError
from sliplens.faithfulness import get_fill
from sliplens.faithfulness.map_quality import relevance_mass, relevance_rank
from sliplens.faithfulness.removal import (
    RANDOM_ORDERS,
    SHARES,
    Faithfulness,
    Redraw,
    RemovalCurves,
    Units,
    answer_whole,
    influence_orders,
    marker_curves,
    removal_curves,
    score_maps_by_marker,
    unit_means,
    unit_order,
)
from sliplens.faithfulness.scoring import prepare_passes
from sliplens.intervals import Difference, paired_difference
from sliplens.models import Run
from sliplens.progress import OnProgress, counted
from sliplens.recordings import Dataset
from sliplens.recordings.trial import SLIPS
from sliplens.results.explanation import Explained
from sliplens.results.study import REGIONS, Localisation, MarkerEffects, MetaTest, OracleTest, Truth
from sliplens.simulation.information import visible_markers
from sliplens.simulation.intervention import (
    FilmedTrial,
    draw_with_markers_back,
    marker_outlines,
    marker_readings,
    rebuild_trial,
)
from sliplens.study.explaining import mean_of_known, network_inputs
from sliplens.study.scoring import require_same_network

_RIM_PX = 1.5
"""How far a marker's edge reaches on either side of its outline, in pixels of the network's input."""
_ROUNDING = 1
"""Grey levels by which an input may differ where another machine resized it."""


@dataclass(frozen=True, kw_only=True)
class StagedFrame:
    """A frame of a study with all that drew it."""

    id: str
    day: int
    trial: str
    number: int
    """In its trial."""
    safety_margin: float
    scene: FilmedTrial
    reference: UInt8[np.ndarray, "height width 3"]
    contact_map: UInt8[np.ndarray, "height width"]
    markers: Int[np.ndarray, " markers"]
    """Numbers of the markers that lie wholly in the image: those cut by its border stay as they are."""


@dataclass(frozen=True, kw_only=True)
class Places:
    """Where the network sees what moves, in pixels of its input."""

    units: Units
    """For each pixel which of the frame's `markers` covers it, where it is or where it was, its rim included: its place
    among them, or their number where there is none."""
    markers: Bool[np.ndarray, "size size"]
    edges: Bool[np.ndarray, "size size"]
    """All markers in the image, those at its border too: their areas, and their rims alone."""
    slip_annulus: Bool[np.ndarray, "size size"]
    """Where the skin slips over the object."""
    now_px: Float[np.ndarray, "markers 2"]
    """Where the frame's `markers` are, as x, y."""
    state: Int[np.ndarray, " markers"]
    """Whether each of them slips (1), sticks (2), or lies outside of the contact (0)."""

    def paint(self, values: Float[np.ndarray, " markers"]) -> Float[np.ndarray, "size size"]:
        """Map with one value on each marker, 0 elsewhere."""
        return np.append(values, 0.0)[self.units]


def stage_frames(trained: Run, explained: Explained, data: Dataset) -> tuple[StagedFrame, ...]:
    """Make frames of a study ready to be drawn anew."""
    require_same_network(trained, explained)
    if not data.simulated or explained.source != "simulated":
        raise InputError(f"{data.folder} was recorded: what each marker does is known of simulated frames alone")
    infos = {info.trial: info for info in data.trials}
    rows: dict[str, list[int]] = {}
    for row, frame in enumerate(explained.frames):
        if frame.trial not in infos:
            raise InputError(f"{data.folder} has no trial {frame.trial}; name the data set whose frames were explained")
        rows.setdefault(frame.trial, []).append(row)
    staged: dict[int, StagedFrame] = {}
    for trial, some in rows.items():
        recording = data.load(infos[trial])
        scene = rebuild_trial(data.folder, recording)
        for row in some:
            name = explained.frames[row].id
            digits = name.removeprefix(f"{trial}-f")
            if digits == name or not digits.isdecimal() or int(digits) >= len(recording.frames):
                raise InputError(f"{name} does not name a frame of trial {trial}; explain frames of a data set")
            number = int(digits)
            compared = trained.encoding.compare(recording.frames[number : number + 1], recording.reference)
            image = trained.encoding.resize(compared, image_size=trained.manifest.image_size)[0].numpy()
            if np.abs(image.astype(np.int16) - explained.images[row].astype(np.int16)).max() > _ROUNDING:
                raise InputError(f"{name} is not the frame of {data.folder} that was explained; explain it again")
            truth = recording.truth
            assert truth is not None  # what was rebuilt has its truth
            staged[row] = StagedFrame(
                id=name,
                day=infos[trial].day,
                trial=trial,
                number=number,
                safety_margin=float(recording.safety_margin[number]),
                scene=scene,
                reference=recording.reference,
                contact_map=truth.contact_map[number],
                markers=visible_markers(scene.film.sensor),
            )
    return tuple(staged[row] for row in range(len(explained.frames)))


def redrawing(trained: Run, frames: Sequence[StagedFrame]) -> Redraw:
    """Draw frames with some of their `markers` put back, as the network gets them, on its device."""

    def redraw(image: int, back: Bool[np.ndarray, "variants markers"]) -> Float[Tensor, "variants 3 size size"]:
        frame = frames[image]
        film = frame.scene.film
        every = np.zeros((len(back), len(film.marker_rest_px)), dtype=bool)
        every[:, frame.markers] = back
        drawn = draw_with_markers_back(film, frame.number, every).numpy()
        return trained.encode(drawn, frame.reference).to(trained.device)

    return redraw


def find_places(frame: StagedFrame, *, image_size: int) -> Places:
    """Where the markers, their rims and the slipping skin are in a network's input."""
    height, width = frame.contact_map.shape
    scale = image_size / width
    steps = np.arange(image_size)
    outlines = marker_outlines(frame.scene.film, frame.number)

    def from_outline(centres_px: np.ndarray, radius_px: np.ndarray) -> Float[np.ndarray, "circles size size"]:
        # pixel centres lie at whole numbers, edges half a pixel before
        centres = (centres_px + 0.5) * scale - 0.5
        away = np.hypot(steps[None, None, :] - centres[:, :1, None], steps[None, :, None] - centres[:, 1:, None])
        return away - radius_px[:, None, None] * scale

    rest = from_outline(outlines.rest_px, outlines.rest_radius_px)
    now = from_outline(outlines.now_px, outlines.now_radius_px)
    beyond = np.minimum(rest, now)
    nearest = beyond.argmin(axis=0)
    covered = beyond.min(axis=0) <= _RIM_PX
    place = np.full(len(outlines.now_px), len(frame.markers))
    place[frame.markers] = np.arange(len(frame.markers))
    # the camera's pixel at the middle of the network's, in whole numbers: halves must not be rounded
    column, row = ((2 * steps + 1) * side // (2 * image_size) for side in (width, height))
    now_px = outlines.now_px[frame.markers]
    x, y = np.clip(np.round(now_px).astype(np.int64), 0, [width - 1, height - 1]).T
    return Places(
        units=np.where(covered, place[nearest], len(frame.markers)),
        markers=covered,
        edges=np.minimum(np.abs(rest), np.abs(now)).min(axis=0) <= _RIM_PX,
        slip_annulus=frame.contact_map[np.ix_(row, column)] == SLIPS,
        now_px=(now_px + 0.5) * scale - 0.5,
        state=frame.contact_map[y, x].astype(np.int64),
    )


TRUE_FILL = "true"
ORACLE, DEGRADED = "oracle", "degraded-oracle"
RANDOM = "random"
"""A map of even noise."""
TRUTH_FILLS = ("reference", "grey", "background", "blur")
"""Fills that the oracle is tried under; the true one always is. The noisy-linear one takes longer than all of them."""

Maps = Float[np.ndarray, "frames size size"]


@dataclass(frozen=True, kw_only=True)
class FrameEffects:
    """What each marker of a frame does, in margin units: the value as it is less the value with the marker put back."""

    network: Float64[np.ndarray, " markers"]
    """Of the network's answer."""
    margin: Float64[np.ndarray, " markers"]
    """Of the margin as the best reader of markers reads it (`simulation.best_reading`)."""
    shuffled: Float64[np.ndarray, " markers"]
    """The network's, those of half of the markers shuffled: an oracle that is half wrong."""
    gains: dict[str, Float64[np.ndarray, "2 2"]]
    """Symmetric gain, under each fill, of the map that has `network` and of the one that has `shuffled`: a row for
    changes by their size, as `Faithfulness` has them, and one for changes counted towards the target."""


def shuffle_half(values: Float[np.ndarray, " markers"], *, rng: np.random.Generator) -> Float[np.ndarray, " markers"]:
    """Shuffle the values of half of the markers among themselves."""
    chosen = rng.permutation(len(values))[: len(values) // 2]
    shuffled = values.copy()
    shuffled[chosen] = values[rng.permutation(chosen)]
    return shuffled


def _gains(curves: RemovalCurves, towards: float) -> Float[np.ndarray, "2 2"]:
    """Symmetric gains of two maps, each removed both ways, by the size of the changes and by their part `towards`."""
    lost = np.trapezoid(curves.lost(np.array([towards]))[:, 0], curves.areas, axis=-1)
    means = np.stack([curves.mean_changes[:, 0], lost])
    return means[:, ::2] - means[:, 1::2]


def marker_means(maps: Maps, places: Sequence[Places]) -> list[Float[np.ndarray, " markers"]]:
    """Mean of each frame's map over each of its markers, where it is and where it was."""
    return [
        unit_means(values.astype(np.float64), one.units)[: len(one.now_px)]
        for values, one in zip(maps, places, strict=True)
    ]


def _by_region(places: Sequence[Places], measure: Callable[[int, np.ndarray], float]) -> dict[str, float | None]:
    """Means over the frames that have the region: where nothing slips there is nothing to find."""
    return {
        region: mean_of_known(
            np.array([measure(at, own) for at, own in enumerate(getattr(one, region) for one in places) if own.any()])
        )
        for region in REGIONS
    }


def rank_correlation(first: Float[np.ndarray, " markers"], second: Float[np.ndarray, " markers"]) -> float:
    """Spearman's rank correlation of the sizes; NaN where one of the two does not vary."""
    first, second = np.abs(first), np.abs(second)
    if len(first) < 2 or np.ptp(first) == 0 or np.ptp(second) == 0:
        return float("nan")
    return float(np.asarray(spearmanr(first, second))[0])


def mean_interval(
    values: Float[np.ndarray, " frames"], clusters: Shaped[np.ndarray, "2 frames"], *, seed: int
) -> Difference | None:
    """Mean over the frames in which it is defined, with a 95 % interval over days and trials; None if in none."""
    known = np.isfinite(values)
    if not known.any():
        return None
    values = values[known]
    return paired_difference(values, 0 * values, clusters=clusters[:, known], rng=np.random.default_rng(seed))


def meta_test(
    effects: Sequence[FrameEffects], clusters: Shaped[np.ndarray, "2 frames"], *, seed: int
) -> tuple[MetaTest, ...]:
    """Whether each fill ranks the map that knows the effects above the one that knows half, and that above chance.

    A gain counts changes of the answer towards the target, as `score_maps` does when it is told; `by_size` counts how
    large they are, where a marker that works against the answer moves it as far as one that works for it.
    """
    tests = []
    for fill in effects[0].gains:
        gains = np.stack([own.gains[fill] for own in effects])
        signed, by_size = (_test_oracle(gains[:, row], clusters, seed=seed) for row in (1, 0))
        tests.append(MetaTest(fill=fill, by_size=by_size, **vars(signed)))
    return tuple(tests)


def _test_oracle(
    gains: Float[np.ndarray, "frames 2"], clusters: Shaped[np.ndarray, "2 frames"], *, seed: int
) -> OracleTest:
    oracle, degraded = gains.mean(axis=0).tolist()
    return OracleTest(
        holds=oracle > degraded > 0,
        oracle=oracle,
        degraded=degraded,
        # a random order turned round is a random order: its symmetric gain is 0 on average
        random=0.0,
        gap=mean_interval(gains[:, 0] - gains[:, 1], clusters, seed=seed),
    )


def _summarise(meta: Sequence[MetaTest], agreement: Difference | None) -> str:
    """Say which fills can tell, and whether the network looks where the best reader would."""
    held, by_size = [test.fill for test in meta if test.holds], [test.fill for test in meta if test.by_size.holds]
    summary = (
        "The map of the network's own marker effects ranks above one of which half is shuffled, and that above chance, "
        f"under {len(held)} of {len(meta)} fills ({', '.join(held) or 'none'}); counted by the size of the answer's "
        f"changes instead of along them, under {len(by_size)} ({', '.join(by_size) or 'none'})."
    )
    if agreement is not None:
        summary += (
            f" Marker by marker the network's effects agree with those on the best reading of the margin by "
            f"{agreement.estimate:.2f} (Spearman, 95 % interval {agreement.low:.2f} to {agreement.high:.2f})."
        )
    return summary


def judge_by_truth(
    trained: Run,
    explained: Explained,
    data: Dataset,
    *,
    maps: Mapping[str, Maps],
    fills: Sequence[str] = TRUTH_FILLS,
    seed: int = 0,
    parts: Path | None = None,
    on_progress: OnProgress | None = None,
) -> Truth:
    """Put every marker of every frame back, and hold maps against what that does.

    A map's mass and rank are those of its positive part, what works towards the answer: a share of a sum needs one
    sign. Marker by marker it is the size of a map's mean that is compared with the size of the effect: a marker that
    works against the answer matters as much as one that works for it, and maps that know no sign can be compared too.

    `maps` are influences by method, controls included; `fills` those under which a map that knows the effects is held
    against one that knows half of them.
    """
    for fill in fills:
        get_fill(fill)
    frames = stage_frames(trained, explained, data)
    places = [find_places(frame, image_size=trained.manifest.image_size) for frame in frames]
    effects = _find_effects(
        trained, explained, frames, places, fills=fills, seed=seed, parts=parts, on_progress=on_progress
    )
    size, towards = trained.manifest.image_size, explained.towards
    judged = dict(maps) | {
        RANDOM: np.random.default_rng(seed).random((len(frames), size, size)),
        ORACLE: _paint(places, [sign * own.network for sign, own in zip(towards, effects, strict=True)]),
        DEGRADED: _paint(places, [sign * own.shuffled for sign, own in zip(towards, effects, strict=True)]),
    }
    clusters = explained.clusters
    own = np.array([rank_correlation(one.network, one.margin) for one in effects])
    meta, agreement = meta_test(effects, clusters, seed=seed), mean_interval(own, clusters, seed=seed)
    return Truth(
        input=explained.input,
        source=explained.source,
        frames=len(frames),
        # the mass of a map of chance
        areas=_by_region(places, lambda _, region: float(region.mean())),
        methods={name: _judge(values, places, effects, clusters, seed=seed) for name, values in judged.items()},
        network_against_margin=agreement,
        meta=meta,
        summary=_summarise(meta, agreement),
        effects=_table(frames, places, effects),
        network_maps=_paint(places, [one.network for one in effects]).astype(np.float32),
        margin_maps=_paint(places, [one.margin for one in effects]).astype(np.float32),
    )


def _judge(
    maps: Maps,
    places: Sequence[Places],
    effects: Sequence[FrameEffects],
    clusters: Shaped[np.ndarray, "2 frames"],
    *,
    seed: int,
) -> Localisation:
    means, positive = marker_means(maps, places), np.clip(maps.astype(np.float64), 0, None)
    edges = [relevance_mass(own, place.edges) - place.edges.mean() for own, place in zip(positive, places, strict=True)]
    network, margin = (
        np.array([rank_correlation(values, truth) for values, truth in zip(means, truths, strict=True)])
        for truths in ([own.network for own in effects], [own.margin for own in effects])
    )
    return Localisation(
        mass=_by_region(places, lambda frame, region: relevance_mass(positive[frame], region)),
        rank=_by_region(places, lambda frame, region: relevance_rank(positive[frame], region)),
        spearman_network=mean_of_known(network),
        spearman_margin=mean_of_known(margin),
        network=mean_interval(network, clusters, seed=seed),
        margin=mean_interval(margin, clusters, seed=seed),
        edges=mean_interval(np.array(edges), clusters, seed=seed),
    )


def _table(frames: Sequence[StagedFrame], places: Sequence[Places], effects: Sequence[FrameEffects]) -> MarkerEffects:
    return MarkerEffects.joined(
        [
            MarkerEffects(
                frame_id=np.repeat(frame.id, len(frame.markers)),
                day=np.repeat(frame.day, len(frame.markers)),
                trial=np.repeat(frame.trial, len(frame.markers)),
                safety_margin=np.full(len(frame.markers), frame.safety_margin),
                marker=frame.markers.astype(np.int64),
                x_px=place.now_px[:, 0],
                y_px=place.now_px[:, 1],
                network=own.network,
                margin=own.margin,
                state=place.state,
            )
            for frame, place, own in zip(frames, places, effects, strict=True)
        ]
    )


def true_curves(
    trained: Run,
    explained: Explained,
    data: Dataset,
    *,
    maps: Mapping[str, Maps],
    random_orders: int = RANDOM_ORDERS,
    seed: int = 0,
    on_progress: OnProgress | None = None,
) -> dict[str, Faithfulness]:
    """Removal curves under the true fill: markers put back, most or least influential first, or in random orders."""
    frames = stage_frames(trained, explained, data)
    places = [find_places(frame, image_size=trained.manifest.image_size) for frame in frames]
    inputs = network_inputs(trained, explained)
    passes = len(frames) * (2 * len(maps) + random_orders) * (len(SHARES) - 2)
    return score_maps_by_marker(
        prepare_passes(trained, inputs, passes),
        redrawing(trained, frames),
        {name: np.stack(marker_means(values, places)) for name, values in maps.items()},
        rng=np.random.default_rng(seed),
        towards=explained.towards,
        random_orders=random_orders,
        on_progress=on_progress,
    )


def _paint(places: Sequence[Places], values: Sequence[Float[np.ndarray, " markers"]]) -> Maps:
    return np.stack([place.paint(own) for place, own in zip(places, values, strict=True)])


def _find_effects(
    trained: Run,
    explained: Explained,
    frames: Sequence[StagedFrame],
    places: Sequence[Places],
    *,
    fills: Sequence[str],
    seed: int,
    parts: Path | None,
    on_progress: OnProgress | None,
) -> list[FrameEffects]:
    """Put every marker back, and see which fills can tell a map that knows its effects from half of one."""
    inputs, redraw = network_inputs(trained, explained), redrawing(trained, frames)
    # each marker alone, and under each fill two maps both ways
    passes = len(frames) * (len(frames[0].markers) + 4 * len(SHARES) * (len(fills) + 1))
    predict = prepare_passes(trained, inputs, passes)

    def find(index: int) -> FrameEffects:
        frame, place, towards = frames[index], places[index], float(explained.towards[index])
        # the whole image first
        back = np.eye(len(frame.markers) + 1, len(frame.markers), k=-1, dtype=bool)
        answers = answer_whole(predict, redraw(index, back), batch_size=64)
        network = answers[0] - answers[1:]
        # a run that goes on draws the same
        shuffled = shuffle_half(network, rng=np.random.default_rng((seed, index)))
        known = [towards * network, towards * shuffled]
        orders = [
            unit_order(place.paint(one), place.units, least_first=least) for one in known for least in (False, True)
        ]
        empty = trained.encoding.empty(frame.reference, image_size=trained.manifest.image_size)
        curves = {
            name: removal_curves(
                predict,
                inputs[index : index + 1],
                np.stack(orders)[:, None],
                fill=get_fill(name),
                references=empty[None].to(trained.device),
                areas=SHARES,
            )
            for name in fills
        }
        curves[TRUE_FILL] = marker_curves(
            predict, lambda _, back: redraw(index, back), np.concatenate([influence_orders(one[None]) for one in known])
        )
        return FrameEffects(
            network=network,
            margin=marker_readings(frame.scene, frame.number)[1],
            shuffled=shuffled,
            gains={name: _gains(own, towards) for name, own in curves.items()},
        )

    return [
        keep_part(parts and parts / f"{index:05d}", FrameEffects, partial(find, index))
        for index in counted(range(len(frames)), on_progress)
    ]
