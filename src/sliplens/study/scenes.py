"""The frames of a study as scenes that can be drawn anew, and where their markers are in the network's input."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from sliplens.errors import InputError
from sliplens.faithfulness.removal import Redraw, Units
from sliplens.models import Run
from sliplens.recordings import Dataset
from sliplens.recordings.trial import SLIPS
from sliplens.results.explanation import Explained
from sliplens.simulation import SimulationRecipe
from sliplens.simulation.information import visible_markers
from sliplens.simulation.intervention import FilmedTrial, draw_with_markers_back, marker_outlines, rebuild_trial

_RIM_PX = 1.5
"""How far a marker's edge reaches on either side of its outline, in pixels of the network's input."""
_ROUNDING = 1
"""Grey levels by which an input may differ where another machine resized it."""


@dataclass(frozen=True, kw_only=True)
class StagedFrame:
    """A frame of a study with all that drew it."""

    id: str
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


def stage_frames(
    trained: Run, explained: Explained, data: Dataset, *, recipe: SimulationRecipe | None = None
) -> tuple[StagedFrame, ...]:
    """Make frames of a study ready to be drawn anew; the data set's folder has the recipe where none is given."""
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
        scene = rebuild_trial(data.folder, recording, recipe=recipe)
        for row in some:
            name = explained.frames[row].id
            number = _number(name, trial, frames=len(recording.frames))
            compared = trained.encoding.compare(recording.frames[number : number + 1], recording.reference)
            image = trained.encoding.resize(compared, image_size=trained.manifest.image_size)[0].numpy()
            if np.abs(image.astype(np.int16) - explained.images[row].astype(np.int16)).max() > _ROUNDING:
                raise InputError(f"{name} is not the frame of {data.folder} that was explained; explain it again")
            truth = recording.truth
            assert truth is not None  # what was rebuilt has its truth
            staged[row] = StagedFrame(
                id=name,
                trial=trial,
                number=number,
                safety_margin=float(recording.safety_margin[number]),
                scene=scene,
                reference=recording.reference,
                contact_map=truth.contact_map[number],
                markers=visible_markers(scene.film.sensor),
            )
    return tuple(staged[row] for row in range(len(explained.frames)))


def _number(name: str, trial: str, *, frames: int) -> int:
    number = name.removeprefix(f"{trial}-f")
    if number == name or not number.isdecimal() or int(number) >= frames:
        raise InputError(f"{name} does not name a frame of trial {trial}; explain frames of a data set")
    return int(number)


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
