"""Explanations compared with the effects of markers on the prediction, which only a simulator knows."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from jaxtyping import Bool, Float, Float64, Int, Int64, Shaped, UInt8
from scipy.stats import spearmanr
from torch import Tensor

from sliplens.explainers.attribution import change_of
from sliplens.explainers.explain import network_inputs, network_references
from sliplens.explainers.occlusion import marker_regions, to_network_px
from sliplens.explainers.shapley import shapley_values
from sliplens.faithfulness import removal
from sliplens.faithfulness.controls import Maps, lead_over_controls, relevance_mass
from sliplens.faithfulness.fills import get_fill
from sliplens.faithfulness.removal import SHARES, Redraw
from sliplens.faithfulness.scoring import frame_columns, prepare_passes, require_same_network
from sliplens.intervals import Difference, mean_interval
from sliplens.models import Network
from sliplens.progress import ignore, reporting
from sliplens.recordings import Dataset, Recording
from sliplens.results.explanation import ExplainedFrame, Explanation
from sliplens.results.faithfulness import CHANCE, RemovalCurve, is_control
from sliplens.results.study import REDRAWN, Localisation, MarkerEffects, MetaTest, NeutralScores, Truth
from sliplens.runner import Part, part
from sliplens.simulation.filming import Film
from sliplens.simulation.trials import put_markers_back, rebuild_trial, visible_markers
from sliplens.study.choice import marker_sums
from sliplens.study.stages import MakeRecord, Stage

GROUPS, GROUP_MARKERS = 24, 5
"""Groups of a frame, and markers of a group."""
MOVED_TO, MOVED_FAR, HIGH = 0.85, 0.3, 0.8
"""Margin to which markers are moved; margin for frames above the third one, which lie too near to the first."""


def neutral_frame(margins: Float[np.ndarray, " frames"], frame: int) -> int:
    """Find the frame of a trial to whose places the markers of a frame are moved; it lies before the first slip."""
    slips = np.flatnonzero(margins <= 0)
    before = margins[: slips[0]] if len(slips) and np.isfinite(margins[: slips[0]]).any() else margins
    wanted = MOVED_FAR if margins[frame] > HIGH else MOVED_TO
    return int(np.nanargmin(np.abs(before - wanted)))


def draw_groups(markers: int, *, rng: np.random.Generator) -> Int64[np.ndarray, "groups members"]:
    """Draw random groups of a frame's markers."""
    size = min(GROUP_MARKERS, markers)
    return np.stack([rng.choice(markers, size, replace=False) for _ in range(GROUPS)])


def correlate_groups(
    values: Float[np.ndarray, " markers"],
    groups: Int[np.ndarray, "groups members"],
    effects: Float[np.ndarray, " groups"],
) -> float:
    """Pearson's correlation of the sums of marker values over groups with the effects of these.

    NaN where the effects do not vary, so that nothing can be judged; 0 where the sums do not.
    """
    sums = values[groups].sum(axis=1)
    if len(effects) < 2 or np.ptp(effects) == 0:
        return float("nan")
    return 0.0 if np.ptp(sums) == 0 else float(np.corrcoef(sums, effects)[0, 1])


_RIM_PX = 1.5
"""How far a marker's edge reaches on either side of its outline, in pixels of the network's input."""


@dataclass(frozen=True, kw_only=True)
class StagedFrame:
    """A frame of a study with all that drew it, and where the network sees its markers, in pixels of its input."""

    explained: ExplainedFrame
    number: int
    """In its trial."""
    safety_margin: float
    neutral_frame: int
    """Frame to whose places groups of markers are moved."""
    film: Film
    reference: UInt8[np.ndarray, "rows columns 3"]
    markers: Int[np.ndarray, " markers"]
    """Numbers of the markers that lie wholly in the image: those cut by its border stay as they are."""
    units: removal.Units
    """For each pixel which of the `markers` covers it, where it is or where the baseline has it, its rim included: its
    place among them, or their number where there is none."""
    edges: Bool[np.ndarray, "size size"]
    """Rims of all markers in the image, those at its border too."""
    regions: Int[np.ndarray, "size size"]
    """Marker near to each pixel, or their number where there is none: all regions are of about one size."""
    now_px: Float[np.ndarray, "markers 2"]
    """Where the `markers` are, as x, y."""
    state: Int[np.ndarray, " markers"]
    """State of each of them: slips (1), sticks (2), or lies outside of the contact (0)."""

    def paint(self, values: Float[np.ndarray, " markers"]) -> Float[np.ndarray, "size size"]:
        """Map with one value on each marker, 0 elsewhere."""
        return np.append(values, 0.0)[self.units]


def stage_frames(trained: Network, explained: Explanation, data: Dataset) -> tuple[StagedFrame, ...]:
    """Make frames of a study ready to be drawn again."""
    require_same_network(trained, explained)
    staged: dict[int, StagedFrame] = {}
    for trial, rows in explained.trials.items():
        recording = data.load(data.find(trial))
        film = rebuild_trial(data.folder, recording)
        for row in rows:
            staged[row] = _stage(explained.frames[row], film, recording, size=trained.manifest.image_size)
    return tuple(staged[row] for row in range(len(explained.frames)))


def _stage(explained: ExplainedFrame, film: Film, recording: Recording, *, size: int) -> StagedFrame:
    assert recording.truth is not None  # a trial that was rebuilt has its truth
    number = int(explained.id.removeprefix(f"{recording.trial}-f"))
    contact_map, markers = recording.truth.contact_map[number], visible_markers(film.sensor)
    height, width = contact_map.shape
    scale, steps = size / width, np.arange(size)
    centres_px, radius_px = film.outlines(number)
    network_px = to_network_px(centres_px[markers], contact_map.shape, image_size=size)

    def from_outline(centres_px: np.ndarray, radius_px: np.ndarray) -> Float[np.ndarray, "circles size size"]:
        # pixel centres lie at whole numbers, edges half a pixel before
        centres = (centres_px + 0.5) * scale - 0.5
        away = np.hypot(steps[None, None, :] - centres[:, :1, None], steps[None, :, None] - centres[:, 1:, None])
        return away - radius_px[:, None, None] * scale

    rest, now = from_outline(*film.outlines(explained.baseline_frame)), from_outline(centres_px, radius_px)
    beyond = np.minimum(rest, now)
    place = np.full(len(centres_px), len(markers))
    place[markers] = np.arange(len(markers))
    x, y = np.clip(np.round(centres_px[markers]).astype(np.int64), 0, [width - 1, height - 1]).T
    return StagedFrame(
        explained=explained,
        number=number,
        safety_margin=float(recording.safety_margin[number]),
        neutral_frame=neutral_frame(recording.safety_margin, number),
        film=film,
        reference=recording.reference,
        markers=markers,
        regions=marker_regions((size, size), network_px).numpy(),
        units=np.where(beyond.min(axis=0) <= _RIM_PX, place[beyond.argmin(axis=0)], len(markers)),
        edges=np.minimum(np.abs(rest), np.abs(now)).min(axis=0) <= _RIM_PX,
        now_px=network_px.numpy(),
        state=contact_map[y, x].astype(np.int64),
    )


def redrawing(trained: Network, frames: Sequence[StagedFrame], *, to: Sequence[int | None] | None = None) -> Redraw:
    """Draw frames with some of their `markers` put back, as the network gets them, on its device.

    `to` are the frames of the trials whose places the markers take; the untouched sensor's where it is None.
    """

    def redraw(image: int, back: Bool[np.ndarray, "variants markers"]) -> Float[Tensor, "variants colours size size"]:
        frame = frames[image]
        every = np.zeros((len(back), len(frame.film.marker_rest_px)), dtype=bool)
        every[:, frame.markers] = back
        drawn = put_markers_back(frame.film, frame.number, every, to=to[image] if to else None).draw_all()
        return trained.encode(drawn, frame.reference).to(trained.device)

    return redraw


ORACLE, DEGRADED = "oracle", "degraded-oracle"
TRUTH_PAIRS = 200
"""Pairs of scenes for the Shapley values of a frame: their standard error is then about a third of their spread."""

_EFFECTS = ("stick", "shapley")
"""Effects that a map is compared with, as `MarkerEffects` and `Localisation` name it."""


@dataclass(frozen=True, kw_only=True)
class FrameEffects:
    """Effects of each marker of a frame, in margin units; columns of `MarkerEffects`."""

    shapley: Float64[np.ndarray, " markers"]
    shapley_error: Float64[np.ndarray, " markers"]
    stick: Float64[np.ndarray, " markers"]
    groups: Int64[np.ndarray, "groups members"]
    """Places of the members among the frame's markers."""
    moved: Float64[np.ndarray, " groups"]
    """Prediction less that with the group moved to where it lies in the neutral frame."""
    shuffled: Float64[np.ndarray, " markers"]
    """`oracle`, the values of half of the markers shuffled: an oracle that is half wrong."""
    gains: dict[str, Float64[np.ndarray, " 3"]]
    """Symmetric gain, under each fill, of the maps that have `oracle`, `shuffled` and |x - b|."""

    @property
    def oracle(self) -> Float64[np.ndarray, " markers"]:
        """Shapley values of the game of the explanation's baseline."""
        return self.shapley if np.isnan(self.stick).all() else self.stick


def shuffle_half(values: Float[np.ndarray, " markers"], *, rng: np.random.Generator) -> Float[np.ndarray, " markers"]:
    """Shuffle the values of half of the markers among themselves."""
    chosen = rng.permutation(len(values))[: len(values) // 2]
    shuffled = values.copy()
    shuffled[chosen] = values[rng.permutation(chosen)]
    return shuffled


def marker_means(maps: Maps, frames: Sequence[StagedFrame]) -> list[Float[np.ndarray, " markers"]]:
    """Mean of each frame's map over each of its markers, where it is and where it was."""
    return [
        removal.unit_means(values.astype(np.float64), frame.units)[: len(frame.markers)]
        for values, frame in zip(maps, frames, strict=True)
    ]


def rank_correlation(first: Float[np.ndarray, " markers"], second: Float[np.ndarray, " markers"]) -> float:
    """Spearman's rank correlation, signed; NaN where one of the two does not vary."""
    if len(first) < 2 or np.ptp(first) == 0 or np.ptp(second) == 0:
        return float("nan")
    return float(np.asarray(spearmanr(first, second))[0])


def mean_of_defined(
    measured: Iterable[float],
    clusters: Shaped[np.ndarray, "levels frames"],
    *,
    seed: int,
    limits: tuple[float, float] = (-np.inf, np.inf),
) -> Difference | None:
    """Mean over the frames in which a score is defined, with its interval (`mean_interval`); None if in none."""
    values = np.array(list(measured))
    valid = np.isfinite(values)
    if not valid.any():
        return None
    rng = np.random.default_rng(seed)
    return mean_interval(values[valid], clusters=clusters[:, valid], rng=rng, limits=limits)


def meta_test(
    effects: Sequence[FrameEffects], interval: Callable[[Iterable[float]], Difference | None]
) -> tuple[MetaTest, ...]:
    """Test whether each fill ranks the map of all effects above the one of which half is shuffled."""
    tests = []
    for fill in effects[0].gains:
        gains = np.stack([effect.gains[fill] for effect in effects])
        oracle, degraded, changed = gains.mean(axis=0).tolist()
        gap = interval(gains[:, 0] - gains[:, 1])
        tests.append(MetaTest(fill=fill, oracle=oracle, degraded=degraded, changed=changed, gap=gap))
    return tuple(tests)


@dataclass(frozen=True, kw_only=True)
class JudgingByTruth(Stage[Truth]):
    """Markers of every frame, a part, put back or moved, and maps compared with what that does.

    The main judge is neutral: no map is made to predict how groups of markers, moved to another margin of the trial,
    change the prediction. Beside it, marker by marker, the mean of a map is compared with Shapley values of the stick
    game and of the untouched game. All are signed, along the change of the prediction, which leaves correlations of
    methods as they are. A control has no sign: it has the one that
    suits it where leads are taken.
    """

    record = FrameEffects
    title = "Putting markers back"

    trained: Network
    explained: Explanation
    data: Dataset
    maps: Mapping[str, Maps]
    """Influences by method, controls included."""
    fills: Sequence[str] = ()
    """Those under which a map that knows the effects is compared with one that knows half of them."""
    pairs: int = TRUTH_PAIRS
    """Number of pairs of scenes behind the Shapley values of a frame and game; at least two a marker are taken."""
    seed: int = 0

    def parts(self) -> Iterator[Part]:
        """Yield all frames."""
        for index, frame in enumerate(self.explained.frames):
            yield part(index, trial=frame.trial, name=frame.id, recipe="truth", content="", first=index, frames=1)

    @cached_property
    def _staged(self) -> tuple[tuple[StagedFrame, ...], int]:
        """Frames, and the number of pairs."""
        frames = stage_frames(self.trained, self.explained, self.data)
        return frames, max([self.pairs, *(2 * len(frame.markers) for frame in frames)])

    def prepare(self) -> MakeRecord:
        """Return the function that puts the markers of a frame back, and tests the fills on what that does."""
        trained, explained, fills, seed = self.trained, self.explained, self.fills, self.seed
        frames, pairs = self._staged
        inputs, redraw = network_inputs(trained, explained), redrawing(trained, frames)
        put_to_baseline = redrawing(trained, frames, to=[frame.explained.baseline_frame for frame in frames])
        move = redrawing(trained, frames, to=[frame.neutral_frame for frame in frames])
        references = network_references(trained, explained).to(trained.device)
        # groups, pairs of scenes of two games, and under each fill three maps both ways
        passes = len(frames) * (GROUPS + 4 * pairs + 6 * len(SHARES) * (len(fills) + 1))
        predict = prepare_passes(trained, inputs, passes)

        def put_back(index: int) -> FrameEffects:
            frame, towards = frames[index], float(explained.towards[index])
            count, answer = len(frame.markers), removal.answer_scenes(predict, partial(redraw, index))
            groups = draw_groups(count, rng=np.random.default_rng((seed, index, GROUPS)))
            # the whole image first
            members = np.zeros((len(groups) + 1, count), dtype=bool)
            np.put_along_axis(members[1:], groups, values=True, axis=1)
            moved = removal.answer_scenes(predict, partial(move, index))(members)
            # a run that goes on draws the same; a first guess would lean the truth towards the map that gave it
            rng = np.random.default_rng((seed, index))
            estimate = shapley_values(lambda stay: answer(~stay), count, pairs=pairs, rng=rng)
            stick, values = np.full(count, np.nan), estimate.values
            if frame.explained.baseline_frame is not None:
                of_stick = removal.answer_scenes(predict, partial(put_to_baseline, index))
                stick = values = shapley_values(lambda stay: of_stick(~stay), count, pairs=pairs, rng=rng).values
            shuffled = shuffle_half(values, rng=rng)
            change = change_of(inputs[index], references[index]).cpu().double().numpy()
            change = removal.unit_means(change, frame.units)[:count]
            maps = {"oracle": towards * values, "shuffled": towards * shuffled, "change": change}
            painted = {name: frame.paint(values)[None] for name, values in maps.items()}
            by_marker = {name: values[None] for name, values in maps.items()}
            score_maps = partial(removal.score_maps, predict, inputs[index, None], painted, [frame.units])
            options = {"rng": rng, "towards": explained.towards[index, None], "random_orders": 0}
            with reporting(ignore):  # a part is a frame, whatever its passes
                curves = {
                    name: score_maps(fill=get_fill(name), references=references[index, None], areas=SHARES, **options)
                    for name in fills
                }
                curves[REDRAWN.fill] = removal.score_maps_by_marker(
                    predict, lambda _, back: put_to_baseline(index, back), by_marker, **options
                )
            return FrameEffects(
                shapley=estimate.values,
                shapley_error=estimate.standard_errors,
                stick=stick,
                groups=groups,
                moved=moved[0] - moved[1:],
                shuffled=shuffled,
                gains={
                    fill: np.concatenate([curve.symmetric_gain for curve in of_fill.values()])
                    for fill, of_fill in curves.items()
                },
            )

        return put_back

    def join(self, records: Sequence[FrameEffects]) -> Truth:
        """Compare the maps with what putting the markers back does."""
        trained, explained, seed, effects = self.trained, self.explained, self.seed, records
        frames, pairs = self._staged
        size = trained.manifest.image_size
        # along the answer's change, as the maps are
        along = [
            {name: sign * getattr(effect, name) for name in (*_EFFECTS, "moved", "oracle", "shuffled")}
            for sign, effect in zip(explained.towards, effects, strict=True)
        ]
        exact = {ORACLE: [rows["oracle"] for rows in along], DEGRADED: [rows["shuffled"] for rows in along]}
        judged = dict(self.maps) | {CHANCE: np.random.default_rng(seed).random((len(frames), size, size))}
        for name, values in exact.items():
            judged[name] = np.stack([frame.paint(value) for frame, value in zip(frames, values, strict=True)])
        values = {
            name: [
                marker_sums(rows, frame.regions, markers=len(frame.markers))
                for rows, frame in zip(rows_of_map, frames, strict=True)
            ]
            for name, rows_of_map in judged.items()
        }
        values |= exact  # by the values themselves: the area on which they are painted is no part of them
        groups, moved = [effect.groups for effect in effects], [rows["moved"] for rows in along]
        neutral = {
            name: np.array([correlate_groups(*of_frame) for of_frame in zip(rows, groups, moved, strict=True)])
            for name, rows in values.items()
        }
        interval = partial(mean_of_defined, clusters=explained.clusters, seed=seed)
        counts = [len(frame.markers) for frame in frames]
        x_px, y_px = np.concatenate([frame.now_px for frame in frames]).T
        return Truth(
            input=explained.input,
            source=explained.source,
            frames=len(frames),
            methods=self._judge(judged, frames, along, neutral),
            pairs=pairs,
            meta=meta_test(effects, interval),
            effects=MarkerEffects(
                **frame_columns(explained, counts),
                safety_margin=np.repeat([frame.safety_margin for frame in frames], counts),
                marker=np.concatenate([frame.markers for frame in frames]).astype(np.int64),
                x_px=x_px,
                y_px=y_px,
                **{
                    name: np.concatenate([getattr(effect, name) for effect in effects])
                    for name in (*_EFFECTS, "shapley_error")
                },
                state=np.concatenate([frame.state for frame in frames]),
            ),
            neutral=NeutralScores(
                **{name: np.tile(column, len(neutral)) for name, column in frame_columns(explained, 1).items()},
                method=np.repeat(list(neutral), len(frames)),
                correlation=np.concatenate(list(neutral.values())),
            ),
        )

    def _judge(
        self,
        maps: Mapping[str, Maps],
        frames: Sequence[StagedFrame],
        effects: Sequence[Mapping[str, Float[np.ndarray, " values"]]],
        neutral: Mapping[str, Float[np.ndarray, " frames"]],
    ) -> dict[str, Localisation]:
        # frames in which nothing changes score no map; the others score all
        valid = np.isfinite(neutral[CHANCE])
        ranks, clusters = {name: rows[valid] for name, rows in neutral.items()}, self.explained.clusters
        # a control has no sign: it gets the better one
        controls = {
            name: np.copysign(1.0, rows.mean()) * rows
            for name, rows in ranks.items()
            if is_control(name) and name != CHANCE and valid.any()
        }
        interval, records = partial(mean_of_defined, clusters=clusters, seed=self.seed, limits=(-1.0, 1.0)), {}
        for name, values in maps.items():
            means = marker_means(values, frames)
            positive, lead = np.clip(values.astype(np.float64), 0, None), None
            if not is_control(name) and name not in (ORACLE, DEGRADED) and valid.any():
                rng = np.random.default_rng(self.seed)
                lead = lead_over_controls(ranks[name], controls, clusters=clusters[:, valid], rng=rng)
            records[name] = Localisation(
                neutral=interval(neutral[name]),
                lead_over_controls=lead,
                edges=interval(
                    relevance_mass(rows, frame.edges) - frame.edges.mean()
                    for rows, frame in zip(positive, frames, strict=True)
                ),
                **{
                    truth: interval(
                        rank_correlation(row, effect[truth]) for row, effect in zip(means, effects, strict=True)
                    )
                    for truth in _EFFECTS
                },
            )
        return records


def true_curves(
    trained: Network,
    explained: Explanation,
    maps: Mapping[str, Maps],
    seed: int = 0,
    *,
    data: Dataset,
    random_orders: int,
) -> dict[str, RemovalCurve]:
    """Removal curves under the true fill: markers put back, most or least influential first, or in random orders."""
    frames = stage_frames(trained, explained, data)
    inputs = network_inputs(trained, explained)
    passes = len(frames) * (2 * len(maps) + random_orders) * (len(SHARES) - 2)
    return removal.score_maps_by_marker(
        prepare_passes(trained, inputs, passes),
        redrawing(trained, frames, to=[frame.explained.baseline_frame for frame in frames]),
        {name: np.stack(marker_means(values, frames)) for name, values in maps.items()},
        rng=np.random.default_rng(seed),
        towards=explained.towards,
        random_orders=random_orders,
    )
