"""Plans of simulated trials: their days, sensors, splits and seeds, from a recipe."""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypedDict, Unpack, get_type_hints

import msgspec
import numpy as np

from sliplens._version import __version__
from sliplens.errors import InputError
from sliplens.extras import pick
from sliplens.files import RUN_FILE, hash_json, read_json, to_builtins
from sliplens.simulation.loading import MINIMUM_FRAMES
from sliplens.simulation.nuisances import Day, Nuisances, draw_camera, draw_day, mount_camera
from sliplens.simulation.sensor import CHROMATOUCH, SENSORS, Sensor

# branches of the seed: draws of one never change those of another
_DAYS, _UNITS, _TRIALS, _CAMERAS = range(4)


@dataclass(frozen=True, kw_only=True)
class SimulationRecipe:
    """Settings of a simulated data set; the same recipe gives the same bytes on the same machine.

    The days and splits follow the thesis: the first day and three quarters of the dry trials of the days between train,
    the other quarter validates, evenly spaced over these days, and the test day tests. Wet trials are all of the test
    day, or assigned to the test days. A number out of range, or too few trials to fill every split, is an `InputError`.
    """

    dry_trials: int | tuple[int, ...] = 40
    """Dealt to the days in turn, or one number for each day."""
    wet_trials: int = 10
    frames_per_trial: int = 200
    frame_totals: dict[str, int] | None = None
    """Frames of train, validation and test, if given: trials then differ in length by a tenth to make them up."""
    release: bool = False
    """If True, the object is let go at the end of each trial."""
    pulls: str = "steady"
    """`steady` pulls last about 5.8 s and the margin falls evenly, so that a sequence of frames shows the time; no two
    `varied` ones are alike."""
    days: int = 4
    test_day: int | None = None
    """The last day if None."""
    test_days: int = 1
    """Number of last days that test, where `test_day` is None: with one alone, one friction and one light decide the
    score."""
    validation_share: float = 0.25
    """Share of the dry trials of the days between that validates."""
    sensor: Sensor = CHROMATOUCH
    displacement: str | None = None
    """Model that moves the markers, see `move_markers`; the sensor's default if None."""
    sensors: int = 2
    """Number of sensors built: their markers differ a little."""
    seed: int = 0
    series: str = ""
    """Name that is drawn into every seed: recipes of two series share no day, no sensor and no trial."""
    nuisances: Nuisances = field(default_factory=Nuisances)

    def __post_init__(self) -> None:
        dry, days, share = np.atleast_1d(self.dry_trials), self.days, self.validation_share
        each_day = isinstance(self.dry_trials, tuple)
        between = dry[1 : self.tested.start - 1].sum() + dry[self.tested.stop - 1 :].sum()
        for name, fits, cure in (
            ("dry_trials", not each_day or len(dry) == days, f"there are {days} days; give one number a day"),
            ("dry_trials", bool(np.all(dry >= 0)), "no day has fewer than 0 trials"),
            ("dry_trials", dry.sum() >= 3, "at least 3 are needed: training, validation and test need one each"),
            ("dry_trials", not each_day or dry[:1].sum() > (not between), "the first day trains; give it more trials"),
            ("wet_trials", self.wet_trials >= 0, "ask for none or more"),
            ("frames_per_trial", self.frames_per_trial >= MINIMUM_FRAMES, f"at least {MINIMUM_FRAMES} are needed"),
            ("days", days >= 2, "at least 2 are needed: the test needs a day of its own"),
            ("sensors", self.sensors >= 1, "ask for one or more"),
            ("seed", self.seed >= 0, "seeds are not negative"),
            ("test_day", self.tested.stop - 1 in range(2, days + 1), f"choose from 2 to {days}: the first day trains"),
            ("test_days", self.test_days in range(1, days), f"of {days} days the first trains; ask for fewer"),
            ("test_days", self.test_day is None or self.test_days == 1, "test_day tests alone; ask for 1"),
            ("validation_share", 0 < share < 1, "it must lie between 0 and 1"),
            ("pulls", self.pulls in {"steady", "varied"}, "choose steady or varied"),
            (
                "displacement",
                self.resolved_displacement in self.sensor.displacements,
                f"sensor {self.sensor.name} has {' and '.join(self.sensor.displacements)}; choose one of them",
            ),
        ):
            if not fits:
                raise InputError(f"{name} is {getattr(self, name)!r}, but {cure}")

    @property
    def tested(self) -> range:
        """Days that test."""
        last = self.days if self.test_day is None else self.test_day
        return range(last - self.test_days + 1, last + 1)

    @property
    def resolved_displacement(self) -> str:
        """Model that moves the markers."""
        return self.sensor.displacements[0] if self.displacement is None else self.displacement

    @property
    def hash(self) -> str:
        """Hash of the recipe and of the version of sliplens that follows it."""
        return hash_json({"recipe": self.to_json(), "sliplens": __version__})

    def to_json(self) -> object:
        """Return the recipe as `run.json` holds it; steady pulls are left out, so that hashes stay."""
        fields = to_builtins(self)
        return {name: value for name, value in fields.items() if name != "pulls" or value != "steady"}


@dataclass(frozen=True, kw_only=True)
class TrialPlan:
    """Plan of one trial, from which `simulate_trial` makes it."""

    trial: str
    """Name, such as day1-dry-003."""
    day: int
    condition: str
    """dry or wet."""
    split: str
    """train, validation or test."""
    frames: int
    seed: int
    """Seed of this trial alone, whatever other trials there are."""
    unit: int
    """Number of the built sensor, from 0."""
    unit_seed: int
    day_seed: int
    day_draw: Day
    recipe: SimulationRecipe
    """Recipe of the whole data set."""


class RecipeChanges(TypedDict, total=False):
    """Changes of a preset; None leaves a field as it is."""

    dry_trials: int | tuple[int, ...] | None
    """Number of trials on the dry object, spread over all days, or that of each day."""
    wet_trials: int | None
    """Number of trials on the wet object, all on the days that test."""
    frames_per_trial: int | None
    """Frames of each trial; the thesis has about 800."""
    days: int | None
    """Number of days, each with its own friction, stiffness and light; the last one tests."""
    test_days: int | None
    """Number of the last days that test."""
    displacement: str | None
    """Motion of the markers. calibrated: as in real ChromaTouch images; half-space: exact contact mechanics."""
    release: bool | None
    """If True, let go of the object at the end of each trial."""
    pulls: str | None
    """steady: in about 5.8 s, the margin falling evenly; varied: in 0.8 to 8 s, with rests, jerks and reversals."""
    nuisances: Nuisances | None
    """Ranges of everything that varies beside the margin."""
    seed: int | None
    """Seed: the same seed gives the same bytes on the same machine."""


def make_recipe(
    preset: str = "small",
    *,
    sensor: str | None = None,
    **changes: Unpack[RecipeChanges],
) -> SimulationRecipe:
    """Return the recipe of a preset with changes.

    Parameters
    ----------
    preset
        `small`, `thesis` or `varied`.
    sensor
        `chromatouch` or `flat-gel`; that of the preset if None.
    changes
        Fields of `SimulationRecipe`, such as `dry_trials`, `frames_per_trial`, `days` or `seed`. None leaves one as it
        is. With other numbers of trials, days or frames the preset's totals no longer hold.

    Raises
    ------
    InputError
        If there is no such preset or sensor, or the recipe cannot be followed.

    Examples
    --------
    >>> make_recipe("thesis", days=6).dry_trials
    191
    """
    start = pick(PRESETS, preset, noun="preset")
    fields: dict[str, object] = {name: value for name, value in changes.items() if value is not None}
    if "days" in fields and "dry_trials" not in fields:
        fields["dry_trials"] = int(np.sum(start.dry_trials))
    if fields.keys() & {"dry_trials", "wet_trials", "days", "test_days", "frames_per_trial"}:
        fields["frame_totals"] = None
    if sensor is not None:
        fields["sensor"] = pick(SENSORS, sensor, noun="sensor")
    return replace(start, **fields)


def read_recipe(folder: Path) -> SimulationRecipe:
    """Read the recipe of a data set from its `run.json`."""
    path = folder / RUN_FILE
    try:
        stored, hints = read_json(path)["config"]["recipe"], get_type_hints(SimulationRecipe)
        sensor = SENSORS[stored.pop("sensor")["name"]]
        fields = {name: msgspec.convert(value, hints[name]) for name, value in stored.items()}
        return SimulationRecipe(sensor=sensor, **fields)
    except (InputError, KeyError, TypeError, AttributeError, ValueError, ArithmeticError):
        raise InputError(f"{path} holds no recipe of trials; choose a data set that `sliplens simulate` made") from None


def plan_trials(recipe: SimulationRecipe) -> tuple[TrialPlan, ...]:
    """Plan the trials of a recipe: names, days, splits and seeds; dry before wet.

    Examples
    --------
    >>> from sliplens.simulation import SimulationRecipe, plan_trials
    >>> plans = plan_trials(SimulationRecipe(dry_trials=8, wet_trials=2, days=4))
    >>> [plan.trial for plan in plans if plan.split == "test"]
    ['day4-dry-001', 'day4-dry-002', 'day4-wet-001', 'day4-wet-002']
    """
    tested = recipe.tested
    # the dry friction of the days is spread over its range: few independent draws may all be alike
    spread = np.random.default_rng(_seed(recipe, _DAYS))
    strata = spread.permutation(recipe.days)
    days = {
        day: draw_day(
            recipe.nuisances,
            quantile=float((strata[day - 1] + spread.uniform()) / recipe.days),
            rng=np.random.default_rng(_seed(recipe, _DAYS, day)),
        )
        for day in range(1, recipe.days + 1)
    }
    cameras = [
        draw_camera(recipe.nuisances, rng=np.random.default_rng(_seed(recipe, _CAMERAS, unit)))
        for unit in range(recipe.sensors)
    ]
    if isinstance(recipe.dry_trials, tuple):
        dry = dict(enumerate(recipe.dry_trials, start=1))
    else:
        dry = _spread(recipe.dry_trials, days=recipe.days, tested=tested)
    wet = {day: len(range(index, recipe.wet_trials, len(tested))) for index, day in enumerate(tested)}
    between = [(day, number) for day in sorted(dry) if day not in (1, *tested) for number in range(1, dry[day] + 1)]
    # without days between, the first day gives up some of its trials
    candidates = between or [(1, number) for number in range(1, dry[1] + 1)]
    count = max(1, round(recipe.validation_share * len(candidates))) if candidates else 0
    validation = {candidates[int((index + 0.5) * len(candidates) / count)] for index in range(count)}

    plans = []
    for day in range(1, recipe.days + 1):
        for condition, trials in (("dry", dry[day]), ("wet", wet.get(day, 0))):
            for number in range(1, trials + 1):
                held_out = condition == "dry" and (day, number) in validation
                split = "test" if day in tested else "validation" if held_out else "train"
                # each day begins with another sensor, so that all are used where days have few trials
                unit = (number + day - 2) % recipe.sensors
                plans.append(
                    TrialPlan(
                        trial=f"day{day}-{condition}-{number:03d}",
                        day=day,
                        condition=condition,
                        split=split,
                        frames=recipe.frames_per_trial,
                        seed=_seed(recipe, _TRIALS, day, condition == "wet", number),
                        unit=unit,
                        unit_seed=_seed(recipe, _UNITS, unit),
                        day_seed=_seed(recipe, _DAYS, day),
                        day_draw=mount_camera(days[day], cameras[unit]),
                        recipe=recipe,
                    )
                )
    return tuple(plans) if recipe.frame_totals is None else _with_totals(plans, recipe.frame_totals)


def _with_totals(plans: Sequence[TrialPlan], totals: dict[str, int]) -> tuple[TrialPlan, ...]:
    """Draw the lengths of the trials so that those of a split sum to its total."""
    lengths: dict[str, int] = {}
    for split, total in totals.items():
        chosen = [plan for plan in plans if plan.split == split]
        # drawn from each trial's seed, so that other trials hardly change its share
        shares = np.array([np.random.default_rng((plan.seed, 0)).uniform(0.9, 1.1) for plan in chosen])
        ends = np.round(np.cumsum(shares) / shares.sum() * total).astype(int)
        lengths |= {plan.trial: int(count) for plan, count in zip(chosen, np.diff(ends, prepend=0), strict=True)}
    return tuple(replace(plan, frames=lengths[plan.trial]) for plan in plans)


def _spread(trials: int, *, days: int, tested: range) -> dict[int, int]:
    """Assign dry trials to the days in turn, to the first and a test day first so that no split is empty."""
    between = [day for day in range(2, days + 1) if day not in tested]
    order = [1, tested[-1], *between, *tested[:-1]]
    counts = {day: len(range(index, trials, len(order))) for index, day in enumerate(order)}
    if not between and counts[1] < 2:  # the first day has to feed two splits
        counts |= {1: 2, tested[-1]: counts[tested[-1]] - 1}
    return counts


def _seed(recipe: SimulationRecipe, *branch: int) -> int:
    series = zlib.crc32(recipe.series.encode())
    key = (*([series] if recipe.series else []), *map(int, branch))
    return int(np.random.SeedSequence(recipe.seed, spawn_key=key).generate_state(2, np.uint64)[0])


PRESETS = {
    "small": SimulationRecipe(dry_trials=96, wet_trials=8, frames_per_trial=48, days=12, series="small"),
    "thesis": SimulationRecipe(
        # 160 training, 20 validation and 21 test trials of about 800 frames
        dry_trials=(100, 40, 40, 11), wet_trials=10, frames_per_trial=800,
        frame_totals={"train": 128_043, "validation": 15_839, "test": 16_875},
        days=4, sensors=1, series="thesis",
        # one sensor for all days: camera and lamps are built into it
        nuisances=Nuisances(
            dry_friction=(0.6, 1.1), wet_friction=(0.45, 0.7),
            sensor_gain=(0.9, 1.1), sensor_white_balance=(0.95, 1.05), sensor_gradient=(0.0, 0.25),
            sensor_glare=(0.5, 1.1), sensor_shift_px=(-3.0, 3.0), sensor_rotation_deg=(-3.0, 3.0),
            gain=(0.98, 1.02), white_balance=(0.995, 1.005), illumination_gradient=(0.0, 0.02), glare=(0.97, 1.03),
            camera_shift_px=(-0.15, 0.15), camera_rotation_deg=(-0.15, 0.15),
        ),
    ),
    "varied": SimulationRecipe(
        # many short trials, each day with three: of long ones a network learns the trials by heart
        dry_trials=2460, wet_trials=60, frames_per_trial=20, days=820, test_days=20, validation_share=0.1,
        sensors=200,
        # how a sensor sits in a gripper differs, so that pulls come from every side; a camera may move a little
        nuisances=Nuisances(
            dry_friction=(0.15, 1.2), shear_direction_deg=(-180.0, 180.0),
            frame_turn_deg=(-0.3, 0.3), frame_zoom=(0.995, 1.005),
        ),
    ),
}  # fmt: skip
"""`small` fits a laptop and shows many days; `thesis` has the days, splits and number of frames of the thesis: Polak,
*Explainable Neural Networks for Incipient Slip Sensing in Robot Tactile Learning*, which gives neither the number of
trials nor the shares of dry and wet ones on the test day: both are assumed, from about 800 frames a trial. `varied` is
for networks that meet other days, sensors and objects; it has no series, as when the shipped networks were trained."""
