"""Simulated trials as a force sensor mounted anyhow records them, and events that labels must not misread.

Each kind changes a simulated trial at three strengths: its loading, with the frames drawn anew where it changed, the
motion of its frames, the axes of its force sensor, or the settings of its labels.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Float, UInt8

from sliplens.images import soften
from sliplens.mechanics import stick_ratio
from sliplens.recordings.capture import Forces
from sliplens.recordings.labels.lag import measure_motion
from sliplens.recordings.trial import ContactState, contact_states
from sliplens.simulation import TrialPlan
from sliplens.simulation.filming import Film
from sliplens.simulation.loading import Loading
from sliplens.simulation.trials import prepare_trial

FORCE_HZ = 500
LONGEST_LAG_S = 0.06
_SAMPLES_A_FRAME = 18  # 27.8 frames a second
_LARGEST_OFFSET_N = 1.0
_FALL_S = 0.06  # of the simulated slip
_QUIET_S = 0.6  # what is recorded after a release


@dataclass(frozen=True, kw_only=True)
class Seen:
    """A simulated trial, before anything spoils it."""

    plan: TrialPlan
    loading: Loading
    """At the force sensor's rate."""
    frames: np.ndarray
    """Which samples have a frame."""
    motion: Float[np.ndarray, " frames"]


def film_trial(plan: TrialPlan) -> Seen:
    """Simulate a trial and measure the motion of its frames."""
    loading, film = prepare_trial(plan)
    frames = np.arange(_SAMPLES_A_FRAME // 2, plan.frames, _SAMPLES_A_FRAME)
    return Seen(
        plan=plan, loading=loading, frames=frames, motion=measure_motion(map(soften, draw_frames(film, frames)))
    )


def draw_frames(film: Film, frames: np.ndarray) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """Draw frames, one at a time."""
    for index in frames:
        yield film.draw(slice(int(index), int(index) + 1))[0].numpy()


def spoil(seen: Seen, *, noise_n: float, rng: np.random.Generator) -> tuple[Forces, int, int]:
    """Forces as a sensor mounted anyhow would record them, the column that presses, and its sign."""
    loading, direction, sign = seen.loading, rng.uniform(-np.pi, np.pi), int(rng.choice((-1, 1)))
    contact = np.stack(
        (
            sign * loading.normal_force_n,
            np.cos(direction) * loading.tangential_force_n,
            np.sin(direction) * loading.tangential_force_n,
        ),
        axis=1,
    )
    order = rng.permutation(3)
    force = contact[:, order] + rng.uniform(-_LARGEST_OFFSET_N, _LARGEST_OFFSET_N, 3)
    force += rng.normal(0, noise_n, force.shape)
    return Forces(time_s=loading.time_s, force_n=force, source=seen.plan.trial), int(np.argmin(order)), sign


@dataclass(frozen=True, kw_only=True)
class Case:
    """A trial to label, and what of it may lose its labels."""

    seen: Seen
    event_s: tuple[tuple[float, float], ...] = ()
    """Spans, in seconds of the force sensor, near to which frames may lose their labels."""
    doubtful: bool = False
    """Whether all labels may be lost: what the user gives is wrong, or every sample."""
    mu: float | None = None
    """Friction that the user gives."""
    slip_s: float | None = None
    """Slip that the user sets."""
    tilt_deg: float = 0.0
    """Angle between the force sensor's normal axis and the contact's."""


Event = Callable[[Seen, int, np.random.Generator], Case]
"""Changes a trial at one of three strengths."""


def slip_index(loading: Loading) -> int:
    """First sample of gross slip."""
    return int(np.argmax(loading.safety_margin == 0))


def static_friction(loading: Loading) -> float:
    """Friction at which the contact slips."""
    return float(loading.static_friction[slip_index(loading)])


def _pulled_to(loading: Loading, share: float) -> float:
    """Moment at which so much of the friction is used."""
    before = loading.safety_margin[: slip_index(loading)]
    return float(loading.time_s[np.flatnonzero(before > 1 - share)[-1] + 1])


def _pick(loading: Loading, index: np.ndarray, *, times: bool) -> Loading:
    """Samples of a loading, at their own times or at those of their new places."""
    values = {field.name: getattr(loading, field.name) for field in fields(loading)}
    picked = {name: np.asarray(value)[index] for name, value in values.items() if name != "contact_state"}
    states = tuple(loading.contact_state[at] for at in index.tolist())
    time_s = picked["time_s"] if times else loading.time_s[: len(index)]
    return Loading(**{**picked, "time_s": time_s, "contact_state": states})


def _film(seen: Seen, change: Callable[[Loading], Loading], *, until_s: float = np.inf) -> Seen:
    """Film a trial anew with another loading, up to a moment; frames that nothing changes are kept."""
    loading, film = prepare_trial(seen.plan, change=change)
    names = ("normal_force_n", "tangential_force_n", "stick_margin", "let_back", "retaken")
    differs = np.zeros(len(loading.time_s), dtype=bool)
    for name in names:
        old, new = getattr(seen.loading, name), getattr(loading, name)
        differs |= ~np.isclose(old, new, rtol=1e-9, atol=1e-12, equal_nan=True)
    frames = seen.frames[loading.time_s[seen.frames] < until_s]
    motion = seen.motion[: len(frames)].copy()
    # the motion of a frame is its difference from the one before it
    again = differs[frames] | np.append(False, differs[frames[:-1]])
    for at in np.flatnonzero(again[1:]) + 1:
        motion[at] = measure_motion(map(soften, draw_frames(film, frames[at - 1 : at + 1])))[1]
    kept = np.flatnonzero(loading.time_s < until_s)
    return replace(seen, loading=_pick(loading, kept, times=True), frames=frames, motion=motion)


def friction_given(seen: Seen, strength: int, rng: np.random.Generator) -> Case:
    """The friction is given as it is, or wrong by a tenth or 40 %, and the slip is searched."""
    error = (0.0, 0.1, 0.4)[strength] * rng.choice((-1, 1))
    return Case(seen=seen, mu=static_friction(seen.loading) * (1 + error), doubtful=strength > 0)


def slip_given(seen: Seen, strength: int, rng: np.random.Generator) -> Case:
    """The slip is set where it is, or late or early by 0.1 or 0.3 s, and the friction is searched."""
    late_s = (0.0, 0.1, 0.3)[strength] * rng.choice((-1, 1))
    slip_s = float(seen.loading.time_s[slip_index(seen.loading)]) + late_s
    return Case(seen=seen, slip_s=slip_s, doubtful=strength > 0)


def release(seen: Seen, strength: int, rng: np.random.Generator) -> Case:
    """The contact is let go before it slips, within 100, 50 or 20 ms; the friction is given."""
    length_s, at_s = (0.1, 0.05, 0.02)[strength], _pulled_to(seen.loading, rng.uniform(0.3, 0.8))

    def change(loading: Loading) -> Loading:
        time_s = loading.time_s
        left, gone = np.clip(1 - (time_s - at_s) / length_s, 0, 1), time_s >= at_s + length_s
        margin = np.where(gone, np.nan, loading.safety_margin)
        stick = np.where(gone, np.nan, loading.stick_margin)
        return replace(
            loading,
            normal_force_n=loading.normal_force_n * left,
            tangential_force_n=loading.tangential_force_n * left,
            safety_margin=margin,
            stick_margin=stick,
            stick_ratio=stick_ratio(stick),
            carried_friction=np.where(gone, 0.0, loading.carried_friction),
            contact_state=contact_states(margin, without=ContactState.NO_CONTACT),
        )

    return Case(
        seen=_film(seen, change, until_s=at_s + length_s + _QUIET_S),
        event_s=((at_s, at_s + length_s),),
        mu=static_friction(seen.loading),
    )


def slip_in_a_sample(seen: Seen, strength: int, rng: np.random.Generator) -> Case:
    """The friction falls from static to kinetic within 20, 10 or 2 ms."""
    del rng  # when it slips is the trial's

    def change(loading: Loading) -> Loading:
        since_s = loading.time_s - loading.time_s[slip_index(loading)]
        length_s = (0.02, 0.01, 0.002)[strength]
        falling = np.clip(since_s, 0, length_s)
        source_s = loading.time_s + falling * (_FALL_S / length_s - 1)
        nearest = np.round(np.interp(source_s, loading.time_s, np.arange(len(since_s)))).astype(int)
        return _pick(loading, nearest, times=False)

    slip_s = float(seen.loading.time_s[slip_index(seen.loading)])
    return Case(seen=_film(seen, change), event_s=((slip_s, slip_s),))


def slip_hardly_seen(seen: Seen, strength: int, rng: np.random.Generator) -> Case:
    """The image moves at the slip by 30, 10 or 0 % of what it does beyond its usual motion."""
    del rng
    since_s = seen.loading.time_s[seen.frames] - seen.loading.time_s[slip_index(seen.loading)]
    usual = float(np.median(seen.motion[(since_s > -0.6) & (since_s < -0.1)]))
    here = (since_s > -0.05) & (since_s < 0.25)
    motion = np.where(here, usual + (0.3, 0.1, 0.0)[strength] * (seen.motion - usual), seen.motion)
    return Case(seen=replace(seen, motion=motion))


def _let_go(seen: Seen, strength: int, rng: np.random.Generator, *, again: bool) -> Case:
    length_s, rest_s, back_s = (0.4, 0.2, 0.1)[strength], 0.3, 0.3
    at_s = _pulled_to(seen.loading, rng.uniform(0.3, 0.75))
    times = np.array([at_s, at_s + length_s, at_s + length_s + rest_s, at_s + length_s + rest_s + back_s])

    def change(loading: Loading) -> Loading:
        time_s = loading.time_s
        left = np.interp(time_s, times, (1.0, 0.0, 0.0, 1.0 if again else 0.0))
        margin = 1 - (1 - loading.safety_margin) * left
        used = 1 - np.nan_to_num(margin, nan=1.0)
        farthest = float(used[np.searchsorted(time_s, at_s)])
        retaken = np.where((time_s > times[2]) & (used < farthest), used, 0.0)
        let_back = np.where((time_s > at_s) & (used < farthest), farthest - used + retaken, 0.0)
        newest = np.where(retaken > 0, 1 - retaken / 2, 1 - let_back / 2)
        stick = np.where((let_back > 0) & ~np.isnan(margin), newest, np.where(left < 1, margin, loading.stick_margin))
        return replace(
            loading,
            tangential_force_n=loading.tangential_force_n * left,
            safety_margin=margin,
            stick_margin=stick,
            stick_ratio=stick_ratio(stick),
            let_back=let_back,
            retaken=retaken,
            contact_state=contact_states(margin, without=ContactState.NO_CONTACT),
        )

    until_s = np.inf if again else float(times[2]) + _QUIET_S
    return Case(seen=_film(seen, change, until_s=until_s), event_s=((at_s, times[1]),), doubtful=not again)


def pull_let_go(seen: Seen, strength: int, rng: np.random.Generator) -> Case:
    """The pull is let go within 0.4, 0.2 or 0.1 s while the contact stays pressed, and pulled again until it slips."""
    return _let_go(seen, strength, rng, again=True)


def pull_let_go_for_good(seen: Seen, strength: int, rng: np.random.Generator) -> Case:
    """The pull is let go and the trial ends: nothing slips, and no friction can be inferred."""
    return _let_go(seen, strength, rng, again=False)


def tilted_axes(seen: Seen, strength: int, rng: np.random.Generator) -> Case:
    """The force sensor is tilted by 5, 15 or 25 degrees."""
    del rng
    return Case(seen=seen, tilt_deg=(5.0, 15.0, 25.0)[strength], doubtful=True)


def still_image(seen: Seen, strength: int, rng: np.random.Generator) -> Case:
    """The image moves by 10, 3 or 0 % of what the contact moves it: the frames are of something else."""
    untouched = np.isnan(seen.loading.safety_margin[seen.frames])
    untouched[0] = False
    calm = seen.motion[untouched & (seen.frames < slip_index(seen.loading))]
    motion = rng.choice(calm, len(seen.motion))
    motion += (0.1, 0.03, 0.0)[strength] * (seen.motion - float(np.median(calm)))
    return Case(seen=replace(seen, motion=np.maximum(motion, 0)), doubtful=True)


def still_forces(seen: Seen, strength: int, rng: np.random.Generator) -> Case:
    """The forces stay as they are from a quarter, half or three quarters of the pull on, and the image moves on."""
    del rng
    loading = seen.loading
    at = int(np.searchsorted(loading.time_s, _pulled_to(loading, (0.75, 0.5, 0.25)[strength])))
    index = np.minimum(np.arange(len(loading.time_s)), at)
    forces = {name: getattr(loading, name)[index] for name in ("normal_force_n", "tangential_force_n")}
    return Case(seen=replace(seen, loading=replace(loading, **forces)), doubtful=True)


EVENTS: dict[str, Event] = {
    "friction given": friction_given,
    "slip given": slip_given,
    "fast release": release,
    "slip in a sample": slip_in_a_sample,
    "slip hardly seen": slip_hardly_seen,
    "pull let go": pull_let_go,
    "pull let go for good": pull_let_go_for_good,
    "tilted axes": tilted_axes,
    "still image": still_image,
    "still forces": still_forces,
}


def tilt(
    force_n: Float[np.ndarray, "samples 3"], normal: int, angle_deg: float, rng: np.random.Generator
) -> np.ndarray:
    """Turn forces about an axis across the one that presses."""
    across = np.delete(np.arange(3), normal)
    direction = np.zeros(3)
    angle = rng.uniform(-np.pi, np.pi)
    direction[across] = np.cos(angle), np.sin(angle)
    # Rodrigues' formula, for each sample
    angle = np.deg2rad(angle_deg)
    return (
        force_n * np.cos(angle)
        + np.cross(direction, force_n) * np.sin(angle)
        + np.outer(force_n @ direction, direction) * (1 - np.cos(angle))
    )


def near_events(case: Case, time_s: Float[np.ndarray, " frames"], *, within_s: float) -> Bool[np.ndarray, " frames"]:
    """Frames that may lose their labels."""
    near = np.full(len(time_s), case.doubtful)
    for start_s, end_s in case.event_s:
        near |= (time_s >= start_s - within_s) & (time_s <= end_s + within_s)
    return near
