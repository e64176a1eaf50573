"""Load on the fingertip through a trial, and the motion of its markers: by a calibrated model or the half-space."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from sliplens import mechanics
from sliplens.recordings.trial import ContactState, contact_states
from sliplens.simulation.nuisances import Grasp
from sliplens.simulation.sensor import Frames, Sensor

_FALL_S = 0.06  # time in which friction falls from static to kinetic once the contact slips (assumed)
_SLIP_SHARE = 0.2  # share of a stick-slip cycle in which the contact slips (assumed)


@dataclass(frozen=True, kw_only=True)
class ContactFriction:
    """Friction of a contact and the share of it that is used, frame by frame."""

    coefficient: Frames
    """Current coefficient: static, kinetic in slip, then what the contact has regained where it sticks."""
    used: Frames
    """Tangential force over the largest that this friction holds."""
    carried: Frames
    """Tangential over normal force at which the contact last slipped."""
    slips: Bool[np.ndarray, " frames"]


def slide(
    since_slip_s: Frames, *, used: Frames, static_friction: Frames, grasp: Grasp, stuck_until: int
) -> ContactFriction:
    """Compute the friction of a contact that slides: a fall from static to kinetic, then stick-slip of a spring-slider.

    The spring reloads the stuck contact at a steady rate from kinetic friction to what the contact regained in that
    short time (a share of static less kinetic: friction ages), then the contact slips back. With a share of 0 it slides
    on evenly. Before the first slip the contact uses the share `used` of the static friction. From `stuck_until` frames
    after it the contact is let go: it slips for good, at its level of that moment.

    Persson, *Sliding Friction* (2000), chapter 3 (spring-slider, stick-slip).
    """
    time_s = np.maximum(since_slip_s, 0)
    kinetic = grasp.kinetic_ratio * static_friction
    gap = static_friction - kinetic
    falling = time_s < _FALL_S
    cycle = np.maximum(time_s - _FALL_S, 0) * grasp.stick_slip_hz % 1.0
    stuck = ~falling & (cycle < 1 - _SLIP_SHARE) & (grasp.stick_slip_share > 0)

    regained = grasp.stick_slip_share * gap
    height = np.where(stuck, cycle / (1 - _SLIP_SHARE), (1 - cycle) / _SLIP_SHARE)
    level = kinetic + np.where(falling, gap * (1 - time_s / _FALL_S), regained * height)
    friction = np.where(stuck, kinetic + regained, level)
    carried = np.where(stuck, kinetic, level)

    first = int(np.searchsorted(since_slip_s, 0.0)) + stuck_until
    if first < len(time_s):
        # pulled no further, the contact holds at its last level and slips as the normal force falls
        last = level[first - 1] / static_friction[first - 1] * static_friction[first:]
        level[first:] = friction[first:] = carried[first:] = last
        stuck[first:] = False
    before = since_slip_s < 0
    return ContactFriction(
        coefficient=np.where(before, static_friction, friction),
        used=np.where(before, used, level / friction),
        carried=np.where(before, 0.0, carried),
        slips=~(before | stuck),
    )


TRIAL_S = 8.0
"""Length of a trial in seconds."""

_PHASES = (0.06, 0.07, 0.07, 0.72, 0.08)
"""Shares of a trial: no contact, press, hold, pull, slide; the pull is longest, for its margins are learnt."""
_RELEASE = (0.05, 0.04)
"""Shares taken from the pull in a trial that ends with a release: letting go, and no contact after."""

MINIMUM_FRAMES = 20
"""Fewer frames leave a phase empty."""


@dataclass(frozen=True, kw_only=True)
class Loading:
    """Forces and labels of every frame of a trial.

    The friction coefficient is static until the contact slips, kinetic while it slides, and partly regained where it
    sticks again. So the margin of a sliding contact is 0 and every margin is 1 - F_t / (mu F_n). Without contact the
    margin is NaN.

    The traction is that of `carried_friction` times the pressure everywhere, from sliding, and on top of it that of a
    Cattaneo-Mindlin contact with the remaining friction and `stick_margin` (Ciavarella and Jaeger's superposition).
    Before the first slip nothing is carried, and the stick margin is the safety margin.

    A pull that is let back slips anew from the rim of the contact, half as far for the same force, and again when it is
    pulled again (Mindlin and Deresiewicz). The traces vanish where the pull returns to where it was let back from.
    """

    time_s: Frames
    normal_force_n: Frames
    tangential_force_n: Frames
    friction_coefficient: Frames
    static_friction: Frames
    safety_margin: Frames
    stick_ratio: Frames
    carried_friction: Frames
    stick_margin: Frames
    """NaN without contact; where the pull was let back, the margin of the newest slip from the rim."""
    let_back: Frames
    """Share of the friction by which the pull went back from its farthest; 0 while it is the farthest."""
    retaken: Frames
    """Share of the friction by which the object was pulled again since."""
    held_s: Frames
    """Time since the object was touched; 0 before."""
    contact_state: tuple[ContactState, ...]

    @property
    def tractions(self) -> list[tuple[float, Frames, Frames]]:
        """Sign, friction and margin of the Cattaneo-Mindlin contacts that add up to the traction."""
        turned = self.let_back > 0
        farthest = np.clip(self.safety_margin - self.let_back + self.retaken, 0, 1)
        farthest = np.where(turned, farthest, self.stick_margin)
        parts = [(1.0, self.friction_coefficient - self.carried_friction, np.nan_to_num(farthest, nan=1.0))]
        if self.carried_friction.any():
            parts.append((1.0, self.carried_friction, np.zeros_like(self.carried_friction)))
        if turned.any():
            twice = 2 * self.friction_coefficient
            parts += [(-1.0, twice, 1 - self.let_back / 2), (1.0, twice, 1 - self.retaken / 2)]
        return parts


_PULLS_S = (0.8, 8.0)  # from the first tug of a varied pull to the slip, drawn evenly in the logarithm: a decade
_MOST_EVENTS = 3  # rests, jerks and lettings back of a pull
_RATE = 3.0  # largest ratio of a ramp's rate to that of the whole pull, before all are scaled to fit
_REST = (0.05, 0.3)  # length of a rest and of each way of a letting back, over that of the pull
_JERK_S = (0.03, 0.1)
_LET_BACK = (0.2, 0.8)  # share of the pull that is let back


def draw_pull(*, progress: Frames, duration_s: float, rng: np.random.Generator) -> tuple[Frames, Frames, Frames]:
    """Draw a varied pull, which uses the friction up from 0 at its beginning to 1 at its end: a chain of ramps.

    Between ramps the pull rests, jerks, or is let back some way and pulled again. `progress` is the time since the
    first tug over the duration, from 0 to 1. Returns the used share of the friction, and `let_back` and `retaken` of
    `Loading`.
    """
    events = rng.choice(["rest", "jerk", "let back"], size=rng.integers(_MOST_EVENTS + 1))
    places = np.append(np.sort(rng.uniform(0.05, 0.95, len(events))), 1.0)
    # level of each corner, and the time to it: a weight, except that of a jerk
    corners, backs = [(0.0, 0.0, 0.0)], list[int]()
    for place, event in zip(places, [*events, "slip"], strict=True):
        level = max(float(place), corners[-1][0])
        corners.append((level, (level - corners[-1][0]) * _RATE ** rng.uniform(-1, 1), 0.0))
        if event == "rest":
            corners.append((level, rng.uniform(*_REST), 0.0))
        elif event == "jerk":
            following = float(places[np.searchsorted(places, level, side="right")])
            jerked = level + rng.uniform(0.3, 0.9) * (following - level)
            corners.append((jerked, 0.0, rng.uniform(*_JERK_S) / duration_s))
        elif event == "let back":
            backs.append(len(corners))
            corners.append((level * (1 - rng.uniform(*_LET_BACK)), rng.uniform(*_REST), 0.0))
            corners.append((level, rng.uniform(*_REST), 0.0))
    levels, weights, jerks = np.array(corners).T
    shares = jerks + weights / sum(weights) * (1 - sum(jerks))
    times = np.cumsum(shares) / shares.sum()
    used = np.interp(progress, times, levels)
    let_back, retaken = np.zeros_like(used), np.zeros_like(used)
    for turn in backs:
        farthest, lowest = levels[turn - 1], levels[turn]
        away = (progress > times[turn - 1]) & (progress < times[turn + 1])
        again = away & (progress > times[turn])
        let_back[away] = farthest - np.where(again, lowest, used)[away]
        retaken[again] = used[again] - lowest
    return used, let_back, retaken


def load_grasp(
    grasp: Grasp, *, frames: int, rng: np.random.Generator, release: bool = False, varied: bool = False
) -> Loading:
    """Load a grasp: press to its force, hold, pull until the friction is used up, then slide (`slide`).

    With `release` the normal force falls to nothing while the object slides, and the last frames have no contact. A
    `varied` pull is drawn (`draw_pull`) and the trial lasts as long as that takes; else the margin falls evenly, in a
    trial of 8 s.
    """
    trial_s, (touch, pressed, pull, slip, let_go, gone) = _phase_ends(frames, rng, release=release, varied=varied)
    index = np.arange(frames)
    progress = index / (frames - 1)
    time_s = index * (trial_s / frames)

    # the touch begins anywhere between two frames: where frames are few, only some trials show the lightest touch
    since_touch = index - touch + 1 - rng.uniform()
    normal = grasp.normal_force_n * _smooth(since_touch / (pressed - touch))
    normal *= 1 + grasp.normal_force_drift * (progress - 0.5) * 2
    if release:
        normal *= 1 - _smooth((index - let_go + 1) / (gone - let_go))
    normal[(index < touch) | (index >= gone)] = 0
    static = grasp.friction * (1 + grasp.friction_drift * (progress - 0.5) * 2)

    pulled = np.clip((index - pull) / (slip - pull), 0, 1)
    if varied:
        used, *history = draw_pull(progress=pulled, duration_s=(slip - pull) * trial_s / frames, rng=rng)
    else:
        # a slow swing of the puller, small enough that the margin never rises
        swing = rng.uniform(-0.5, 0.5) * np.sin(2 * np.pi * pulled) / (2 * np.pi)
        used, history = np.clip(pulled + swing, 0, 1), [np.zeros(frames)] * 2
    since_slip_s, stuck_until = time_s - time_s[slip], let_go - slip
    friction = slide(since_slip_s, used=used, static_friction=static, grasp=grasp, stuck_until=stuck_until)
    held_s = np.where(index < touch, 0, time_s - time_s[touch])
    return _label(time_s, normal=normal, static=static, friction=friction, held_s=held_s, history=history)


def load_at_margins(margins: Frames, *, grasp: Grasp) -> Loading:
    """Load a grasp so that its frames have given margins, at its full normal force; NaN is no contact.

    Of the grasp only force and friction count, not drift, creep and the kinetic ratio.
    """
    every = np.ones(len(margins))
    return load_at_states(grasp.normal_force_n * every, friction=grasp.friction * every, margins=margins)


def load_at_states(
    normal_force_n: Frames, *, friction: Frames, margins: Frames, held_s: Frames | None = None
) -> Loading:
    """Load a contact so that its frames have given normal forces, frictions and margins, without a history.

    A margin of 0 slips, one of NaN is no contact; `held_s` is the time since the touch, with which creep grows.
    """
    nothing = np.zeros(len(margins))
    used = 1 - np.nan_to_num(margins, nan=1.0)
    states = ContactFriction(coefficient=friction, used=used, carried=nothing, slips=margins == 0)
    normal = np.where(np.isnan(margins), 0.0, normal_force_n)
    time_s = np.arange(len(margins), dtype=np.float64)
    held_s = nothing if held_s is None else held_s
    return _label(time_s, normal=normal, static=friction, friction=states, held_s=held_s, history=[nothing] * 2)


def _label(
    time_s: Frames, *, normal: Frames, static: Frames, friction: ContactFriction, held_s: Frames, history: list[Frames]
) -> Loading:
    """Compute forces and labels of frames from the share of the friction that they use."""
    let_back, retaken = history
    coefficient, carried, slips = friction.coefficient, friction.carried, friction.slips
    tangential = friction.used * coefficient * normal
    # rounding alone would leave a sliding contact a margin of 1e-16
    margin = np.where(slips & (normal > 0), 0.0, mechanics.safety_margin(normal, tangential, coefficient))
    rest = coefficient - carried
    on_top = np.clip((friction.used * coefficient - carried) / np.where(rest > 0, rest, 1), 0, 1)
    again = ~np.isnan(margin) & ~slips & (carried > 0)
    stick_margin = np.where(again, 1 - on_top, margin)
    # of the slip that last began at the rim of the contact
    newest = np.where(retaken > 0, 1 - retaken / 2, 1 - let_back / 2)
    stick_margin = np.where((let_back > 0) & ~np.isnan(stick_margin), newest, stick_margin)
    return Loading(
        time_s=time_s,
        normal_force_n=normal,
        tangential_force_n=tangential,
        friction_coefficient=coefficient,
        static_friction=static,
        safety_margin=margin,
        stick_ratio=mechanics.stick_ratio(stick_margin),
        carried_friction=carried,
        stick_margin=stick_margin,
        let_back=let_back,
        retaken=retaken,
        held_s=held_s,
        contact_state=contact_states(margin, without=ContactState.NO_CONTACT),
    )


def _phase_ends(frames: int, rng: np.random.Generator, *, release: bool, varied: bool) -> tuple[float, tuple[int, ...]]:
    """Draw the length of the trial in seconds, and the first frame after each phase."""
    shares, trial_s = np.array((*_PHASES, *(_RELEASE if release else (0.0, 0.0)))), TRIAL_S
    factors = rng.uniform(0.8, 1.2, len(shares))
    if varied:
        seconds = TRIAL_S * shares * factors
        seconds[3] = np.exp(rng.uniform(*np.log(_PULLS_S)))
        trial_s = float(seconds.sum())
        shares, factors = np.where(shares > 0, seconds / trial_s, 0), np.ones(len(shares))
    lengths = np.round(frames * shares * factors).astype(int)
    lengths[shares > 0] = np.maximum(1, lengths[shares > 0])
    lengths[3] += frames - lengths.sum()
    return trial_s, tuple(np.cumsum(lengths)[:-1].tolist())


def _smooth(progress: Frames) -> Frames:
    """Rise from 0 to 1 with a soft start and stop, like a servo."""
    inside = np.clip(progress, 0, 1)
    return inside**2 * (3 - 2 * inside)


_FITTED_FRICTION = 0.775
"""Friction ascribed to the trial of the real images, which names none: the dry range's geometric mean (assumed)."""


@dataclass(frozen=True, kw_only=True)
class Displacement:
    """Give of a fingertip: an elastic half-space held by its base, and a shear of the whole skin."""

    layer: float
    """Indentation over Hertz's for the same contact: on a hard core the gel is a layer; a thin one has half of it."""
    local_friction: float
    """Share of the friction that shows as Cattaneo and Mindlin's local field."""
    clamp_exponent: float
    """The base holds the gel: local displacements fade with the cosine of the polar angle to this power."""
    skin_shear: float
    """Shear of the whole skin at full slip in the fitted trial, in radii; as Mindlin's it grows with mu P / a, that is
    with mu times the indentation, and with the pull as 1 - Gamma^p."""


DISPLACEMENTS = {
    # fitted, with the defaults of `Grasp`, to 34 markers x 4 frames of the published difference images
    "calibrated": Displacement(
        layer=0.69, local_friction=0.042 / _FITTED_FRICTION, clamp_exponent=0.76, skin_shear=0.0307
    ),
    # the exponent where a half-space alone was fitted to those markers
    "half-space": Displacement(layer=1.0, local_friction=1.0, clamp_exponent=1.6, skin_shear=0.0),
}
"""`calibrated` moves as the real ChromaTouch did, and its stick zone is nominal; `half-space` is exact mechanics."""


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Markers and contact through a trial; pixels are those of a camera that sits as drawn."""

    rest_px: Float[np.ndarray, "markers 2"]
    centres_px: Float[np.ndarray, "frames markers 2"]
    scale: Float[np.ndarray, "frames markers"]
    """Size over the size at rest; a marker that comes nearer looks larger."""
    touch: Float[np.ndarray, " frames"]
    """Indentation over that of the nominal grasp; 0 without contact."""
    nominal_radius_m: float
    contact_centre_m: Float[np.ndarray, "2"]
    pressure: Float[np.ndarray, "frames markers"]
    """Hertz's pressure on each marker over the peak of the nominal grasp's."""
    indentation_m: Float[np.ndarray, " frames"]
    contact_radius_m: Float[np.ndarray, " frames"]
    stick_radius_m: Float[np.ndarray, " frames"]


def move_markers(sensor: Sensor, grasp: Grasp, *, loading: Loading, displacement: str | None = None) -> Motion:
    """Displace a sensor's markers by a loading, and by the offset, tilt, shear and creep of the grasp.

    `displacement`: a row of `DISPLACEMENTS`; the sensor's default if None.
    """
    name = sensor.displacements[0] if displacement is None else displacement
    model = DISPLACEMENTS[name]
    modulus_pa = sensor.youngs_modulus_pa
    if name == "calibrated" and sensor.effective_modulus_pa is not None:
        modulus_pa = sensor.effective_modulus_pa
    geometry = sensor.geometry
    sphere_m, depth_m = geometry.sphere_radius_m, grasp.marker_depth * geometry.sphere_radius_m
    rest = geometry.marker_positions(depth_m)
    creep = 1 + grasp.creep * (1 - np.exp(-loading.held_s / grasp.creep_time_s))

    def radius(force_n: np.ndarray, factor: float) -> np.ndarray:
        modulus = mechanics.reduced_modulus(youngs_modulus_pa=modulus_pa * factor, poisson_ratio=sensor.poisson_ratio)
        return np.asarray(mechanics.contact_radius(force_n, sphere_radius_m=sphere_m, reduced_modulus_pa=modulus))

    contact_m = radius(loading.normal_force_n * creep, grasp.modulus_factor)
    nominal_m = radius(np.array([Grasp().normal_force_n]), 1.0)
    sunken = (contact_m / nominal_m) ** 2
    clamp = geometry.slope_cosine(rest) ** model.clamp_exponent
    centre_m = np.asarray(grasp.contact_offset) * sphere_m
    from_centre = rest[:, :2] - centre_m
    distance = np.linalg.norm(from_centre, axis=-1)
    lengths_m = {"contact_radius_m": contact_m[:, None], "sphere_radius_m": sphere_m}
    outward, inward = mechanics.hertz_displacement(distance, depth_m, **lengths_m, poisson_ratio=sensor.poisson_ratio)
    yielding = model.layer * clamp
    outward, inward = outward * yielding / np.where(distance > 0, distance, 1), inward * yielding
    pull = np.array([np.cos(grasp.shear_direction_rad), np.sin(grasp.shear_direction_rad)])
    athwart = np.array([-pull[1], pull[0]])
    # a tilted object pushes a little sideways
    moved = rest + outward[..., None] * np.append(from_centre, np.zeros((len(rest), 1)), axis=1)
    moved += inward[..., None] * np.append(np.tan(grasp.tilt_rad), -1)
    for sign, *traction in loading.tractions:
        friction, margin = (values[:, None] for values in traction)
        along, across, sunk = mechanics.partial_slip_displacement(
            from_centre @ pull,
            from_centre @ athwart,
            depth_m,
            friction_coefficient=friction * model.local_friction,
            safety_margin=margin,
            **lengths_m,
            poisson_ratio=sensor.poisson_ratio,
        )
        skin = model.skin_shear * sphere_m * friction / _FITTED_FRICTION * sunken[:, None]
        along = (along + skin * (1 - margin**grasp.shear_exponent)) * (sign * clamp)
        moved[..., :2] += along[..., None] * pull + (across * (sign * clamp))[..., None] * athwart
        moved[..., 2] -= sunk * (sign * clamp)
    return Motion(
        rest_px=geometry.project(rest),
        centres_px=geometry.project(moved),
        scale=geometry.camera_distance(rest) / geometry.camera_distance(moved),
        touch=sunken,
        pressure=np.sqrt(np.maximum(contact_m[:, None] ** 2 - distance**2, 0)) / nominal_m,
        indentation_m=model.layer * np.asarray(mechanics.indentation(contact_m, sphere_radius_m=sphere_m)),
        nominal_radius_m=float(nominal_m[0]),
        contact_centre_m=centre_m,
        contact_radius_m=contact_m,
        stick_radius_m=np.asarray(mechanics.stick_radius(contact_m, np.nan_to_num(loading.stick_margin, nan=0.0))),
    )
