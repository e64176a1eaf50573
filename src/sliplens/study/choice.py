"""Choose what a study looks at: trials that the networks read well, frames along the margin, and their markers."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import groupby

import numpy as np
from jaxtyping import Float

from sliplens.errors import ImageError, InputError, RecordingError
from sliplens.images import absolute_difference
from sliplens.markers import track_markers
from sliplens.models import Run
from sliplens.progress import OnProgress, counted
from sliplens.recordings import Dataset, Recording
from sliplens.results.study import Choice, ChosenFrame, ChosenTrial, MarkedFrame, MarkerTable, ShownFrame, States
from sliplens.study.explaining import DEFAULT_LEVELS as LEVELS
from sliplens.study.explaining import nearest_frame

SCORED_LEVELS = (0.4, 0.2, 0.0)
"""Margins at which the thesis scores: near slip, where there is much to explain."""
_REACH = 0.05
"""How far the frame nearest to a level may lie from it, in margin units."""


def choose_frames(
    networks: Mapping[str, Run],
    data: Dataset,
    *,
    split: str = "test",
    condition: str = "dry",
    trials: int = 14,
    tolerance: float = 0.03,
    on_progress: OnProgress | None = None,
) -> Choice:
    """Choose trials in which every network reads the frames along the margin within a tolerance, in margin units.

    An explanation of a wrong answer explains the error. Where fewer trials qualify than are wanted, those whose worst
    error is smallest are taken too; where more do, the first of them in the data set's order. In each the frames
    nearest to `LEVELS` are taken: those at `SCORED_LEVELS`, and all of the trial that the panels show, the best read.

    References
    ----------
    Polak, section 4: 14 trials read within 3 %, 6 levels, 42 frames to score.
    """
    if not networks:
        raise InputError("a study needs a network; name one for difference images, for raw ones, or both")
    if trials < 1:
        raise InputError(f"a study of {trials} trials is impossible; ask for 1 or more")
    if not 0 <= tolerance <= 1:
        raise InputError(f"the tolerance is {tolerance:g}; give a share of the margin between 0 and 1")
    infos = data.select(split=split, condition=condition)
    candidates: list[tuple[ChosenTrial, list[tuple[int, float]]]] = []
    errors: dict[str, dict[str, Float[np.ndarray, " levels"]]] = {}
    scored = [level in SCORED_LEVELS for level in LEVELS]
    for info in counted(infos, on_progress):
        recording = data.load(info, truth=False)
        margin = np.where(recording.labelled, recording.safety_margin, np.nan)
        rows = [nearest_frame(margin, level) for level in LEVELS] if np.isfinite(margin).any() else []
        near = bool(rows) and all(abs(margin[row] - level) <= _REACH for row, level in zip(rows, LEVELS, strict=True))
        if near and len(set(rows)) == len(rows):
            own = errors[info.trial] = {}
            for name, trained in networks.items():
                answers = trained.predict(trained.encode(recording.frames[rows], recording.reference)).numpy()
                own[name] = np.abs(answers - margin[rows])
            worst = {name: float(values.max()) for name, values in own.items()}
            trial = ChosenTrial(trial=info.trial, qualified=max(worst.values()) <= tolerance, worst_error=worst)
            candidates.append((trial, [(row, float(margin[row])) for row in rows]))
    if not candidates:
        raise RecordingError(
            f"none of the {len(infos)} {condition} trials of split {split!r} has a labelled frame within {_REACH:.0%} "
            f"of each of {', '.join(f'{level:.0%}' for level in LEVELS)}; choose another split or condition, or trials "
            "with more frames from full stick to full slip"
        )
    days = {info.trial: info.day for info in infos}
    # sorting is stable: those that qualify keep the data set's order, so that none is picked for its looks
    taken = sorted(candidates, key=lambda item: 0.0 if item[0].qualified else item[0].worst)[:trials]
    shown = min((trial for trial, _ in taken), key=lambda trial: trial.worst).trial
    frames = tuple(
        ChosenFrame(
            id=f"{trial.trial}-f{row:04d}",
            trial=trial.trial,
            day=days[trial.trial],
            frame=row,
            level=level,
            safety_margin=label,
            scored=level in SCORED_LEVELS,
            shown=trial.trial == shown,
        )
        for trial, rows in taken
        for level, (row, label) in zip(LEVELS, rows, strict=True)
        if level in SCORED_LEVELS or trial.trial == shown
    )
    choice = Choice(
        trials_wanted=trials,
        tolerance=tolerance,
        considered=len(candidates),
        qualified=sum(trial.qualified for trial, _ in candidates),
        qualified_alone={
            name: sum(trial.worst_error[name] <= tolerance for trial, _ in candidates) for name in networks
        },
        mean_error={
            name: float(np.mean([errors[trial.trial][name][scored] for trial, _ in taken])) for name in networks
        },
        summary="",
        source=data.source,
        condition=condition,
        inputs=tuple(networks),
        levels=LEVELS,
        scored_levels=SCORED_LEVELS,
        trials=tuple(trial for trial, _ in taken),
        frames=frames,
    )
    return replace(choice, summary=_summarise(choice, len(infos)))


def _summarise(choice: Choice, trials: int) -> str:
    networks, taken, wanted = len(choice.inputs), choice.trials, choice.trials_wanted
    who = "the network reads" if networks == 1 else "both networks read"
    summary = (
        f"Of {trials} {choice.condition} trials {choice.considered} have a frame near every level, and in "
        f"{choice.qualified} of those {who} every such frame within {choice.tolerance:.0%}."
    )
    others = [trial for trial in taken if not trial.qualified]
    if others:
        worst = max(trial.worst for trial in others)
        summary += (
            f" {wanted} were wanted, so the {len(others)} read best among the others were taken too; the worst of "
            f"their answers is off by {worst:.0%}."
        )
    elif choice.qualified > wanted:
        summary += f" The first {wanted} were taken."
    errors = " and ".join(f"{100 * error:.0f} points ({name} images)" for name, error in choice.mean_error.items())
    summary += f" The answers on the frames to score are off by {errors} on average."
    if len(taken) < wanted:
        summary += f" There were no more: {len(taken)} instead of {wanted}."
    return summary


def show_states(choice: Choice, data: Dataset, *, on_progress: OnProgress | None = None) -> States:
    """Pictures of the shown frames, raw and difference, and the markers of every chosen frame.

    The simulator knows the markers' places; in recorded trials they are followed from the untouched sensor on. A trial
    in which they cannot be followed has none, and the result says why.
    """
    infos = {info.trial: info for info in data.trials}
    # so that the table of a study without markers has its columns
    tables = [_table("", np.empty((0, 2)), np.empty((0, 2)))]
    shown, raw, difference, untracked = [], [], [], []
    simulated = True
    groups = [(trial, list(own)) for trial, own in groupby(choice.frames, key=lambda frame: frame.trial)]
    for trial, chosen in counted(groups, on_progress):
        recording = data.load(infos[trial])
        simulated = simulated and recording.truth is not None
        try:
            tables += _markers(recording, chosen)
        except (ImageError, InputError) as error:
            untracked.append(f"{trial}: {error}")
        for frame in chosen:
            if frame.shown:
                state, margin = str(recording.contact_state[frame.frame]).replace("_", " "), frame.safety_margin
                shown.append(ShownFrame(id=frame.id, level=frame.level, safety_margin=margin, contact_state=state))
                raw.append(recording.frames[frame.frame])
                difference.append(absolute_difference(raw[-1][None], recording.reference)[0])
    return States(
        trial=next(frame.trial for frame in choice.frames if frame.shown),
        markers_from="simulation" if simulated else "tracking",
        shown=tuple(shown),
        untracked=tuple(untracked),
        raw=np.stack(raw),
        difference=np.stack(difference),
        table=MarkerTable.joined(tables),
    )


def _markers(recording: Recording, chosen: Sequence[ChosenFrame]) -> list[MarkerTable]:
    rows, truth = [frame.frame for frame in chosen], recording.truth
    if truth is not None:
        rest, places = truth.marker_rest_px.astype(np.float64), truth.marker_px.astype(np.float64)
    else:
        tracks = track_markers(recording.frames[: max(rows) + 1], recording.reference)
        rest, places = tracks.rest_px, np.where(tracks.followed[..., None], tracks.position_px, np.nan)
    return [_table(frame.id, rest, places[frame.frame]) for frame in chosen]


def _table(frame_id: str, rest: Float[np.ndarray, "markers 2"], now: Float[np.ndarray, "markers 2"]) -> MarkerTable:
    names, marker = np.repeat(frame_id, len(rest)), np.arange(len(rest))
    (rest_x, rest_y), (x, y) = rest.T, now.T
    return MarkerTable(frame_id=names, marker=marker, rest_x_px=rest_x, rest_y_px=rest_y, x_px=x, y_px=y)


def network_places(
    marked: MarkedFrame, *, frame_size: tuple[int, int], image_size: int
) -> tuple[Float[np.ndarray, "seen 2"], float]:
    """Where a network sees the markers (x, y), and how far each one's surroundings reach, in its own pixels.

    A difference image shows a marker where it was and where it is; so its place is half-way, and half of the pitch, the
    median distance between neighbours, reaches both. Markers that were not followed are left out.
    """
    middle = (marked.rest_px + marked.now_px) / 2
    middle = middle[np.isfinite(middle).all(axis=1)]
    scale = image_size / np.array([frame_size[1], frame_size[0]])
    # pixel centres lie at whole numbers, edges half a pixel before
    centres = (middle + 0.5) * scale - 0.5
    between = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
    np.fill_diagonal(between, np.inf)
    return centres, float(np.median(between.min(axis=1))) / 2
