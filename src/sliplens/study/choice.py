"""Choose what a study looks at: trials that the networks read well, and in each the frames along the margin."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from sliplens.errors import InputError, RecordingError
from sliplens.models import Run
from sliplens.progress import OnProgress, counted
from sliplens.recordings import Dataset
from sliplens.results.study import Choice, ChosenFrame, ChosenTrial
from sliplens.study.explaining import DEFAULT_LEVELS, nearest_frame

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
    levels: Sequence[float] = DEFAULT_LEVELS,
    scored_levels: Sequence[float] = SCORED_LEVELS,
    shown_trials: int = 1,
    on_progress: OnProgress | None = None,
) -> Choice:
    """Choose trials in which every network reads the frames along the margin within a tolerance, in margin units.

    An explanation of a wrong answer explains the error. Where fewer trials qualify than are wanted, those whose worst
    error is smallest are taken too; where more do, the first of them in the data set's order. In each the frames
    nearest to the levels are taken: those at scored levels, and all where the panels show the trial, the best read
    first.

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
    if any(not 0 <= level <= 1 for level in levels):
        raise InputError(f"levels must lie in [0, 1], got {', '.join(f'{level:g}' for level in levels)}")
    absent = [level for level in scored_levels if level not in levels]
    if absent or not scored_levels:
        raise InputError(
            f"scored levels must be some of the levels {', '.join(f'{level:g}' for level in levels)}, got "
            f"{', '.join(f'{level:g}' for level in scored_levels) or 'none'}"
        )
    infos = data.select(split=split, condition=condition)
    candidates: list[tuple[ChosenTrial, list[tuple[int, float]]]] = []
    for info in counted(infos, on_progress):
        recording = data.load(info, truth=False)
        margin = np.where(recording.labelled, recording.safety_margin, np.nan)
        rows = [nearest_frame(margin, level) for level in levels] if np.isfinite(margin).any() else []
        near = bool(rows) and all(abs(margin[row] - level) <= _REACH for row, level in zip(rows, levels, strict=True))
        if near and len(set(rows)) == len(rows):
            worst = {}
            for name, trained in networks.items():
                answers = trained.predict(trained.encode(recording.frames[rows], recording.reference)).numpy()
                worst[name] = float(np.abs(answers - margin[rows]).max())
            trial = ChosenTrial(trial=info.trial, qualified=max(worst.values()) <= tolerance, worst_error=worst)
            candidates.append((trial, [(row, float(margin[row])) for row in rows]))
    if not candidates:
        raise RecordingError(
            f"none of the {len(infos)} {condition} trials of split {split!r} has a labelled frame within {_REACH:.0%} "
            f"of each of {', '.join(f'{level:.0%}' for level in levels)}; choose other levels or another split"
        )
    # sorting is stable: those that qualify keep the data set's order, so that none is picked for its looks
    taken = sorted(candidates, key=lambda item: 0.0 if item[0].qualified else max(item[0].worst_error.values()))[
        :trials
    ]
    best_read = sorted(taken, key=lambda item: max(item[0].worst_error.values()))[:shown_trials]
    shown = {trial.trial for trial, _ in best_read}
    frames = tuple(
        ChosenFrame(
            id=f"{trial.trial}-f{row:04d}",
            trial=trial.trial,
            frame=row,
            level=float(level),
            safety_margin=label,
            scored=level in scored_levels,
            shown=trial.trial in shown,
        )
        for trial, rows in taken
        for level, (row, label) in zip(levels, rows, strict=True)
        if level in scored_levels or trial.trial in shown
    )
    qualified = sum(trial.qualified for trial, _ in candidates)
    choice = Choice(
        trials_wanted=trials,
        tolerance=tolerance,
        considered=len(candidates),
        qualified=qualified,
        summary="",
        source=data.source,
        condition=condition,
        inputs=tuple(networks),
        levels=tuple(float(level) for level in levels),
        scored_levels=tuple(float(level) for level in scored_levels),
        trials=tuple(trial for trial, _ in taken),
        frames=frames,
    )
    return replace(choice, summary=_summarise(choice, len(infos)))


def _summarise(choice: Choice, trials: int) -> str:
    networks, taken, wanted = len(choice.inputs), choice.trials, choice.trials_wanted
    who = "the network reads" if networks == 1 else "both networks read" if networks == 2 else "all networks read"
    summary = (
        f"Of {trials} {choice.condition} trials {choice.considered} have a frame near every level, and in "
        f"{choice.qualified} of those {who} every such frame within {choice.tolerance:.0%}."
    )
    others = [trial for trial in taken if not trial.qualified]
    if others:
        worst = max(max(trial.worst_error.values()) for trial in others)
        summary += (
            f" {wanted} were wanted, so the {len(others)} read best among the others were taken too; the worst of "
            f"their answers is off by {worst:.0%}."
        )
    elif choice.qualified > wanted:
        summary += f" The first {wanted} were taken."
    if len(taken) < wanted:
        summary += f" There were no more: {len(taken)} instead of {wanted}."
    return summary
