"""Simulated trials: from a plan to a recording, to a data set on disk, or to frames drawn when asked for."""

import weakref
from collections import OrderedDict
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset as TorchDataset

from sliplens.errors import InputError
from sliplens.extras import require_device
from sliplens.files import output_folder, scratch_folder
from sliplens.progress import OnProgress, counted, number_of, stage, wrote
from sliplens.recordings import Dataset, GroundTruth, Recording
from sliplens.recordings.dataset import load_dataset, trial_info, trial_path, write_dataset_table
from sliplens.recordings.store import read_header, save_recording
from sliplens.recordings.trial import SIGNALS
from sliplens.simulation.filming import Film, batches, move_camera, prepare_film
from sliplens.simulation.loading import Loading, load_grasp
from sliplens.simulation.nuisances import draw_grasp, draw_unit
from sliplens.simulation.plan import SimulationRecipe, TrialPlan, make_recipe, plan_trials


def prepare_trial(plan: TrialPlan, *, change: Callable[[Loading], Loading] | None = None) -> tuple[Loading, Film]:
    """Load a trial, change its loading if asked, and make it ready to be drawn."""
    recipe, unit_rng = plan.recipe, np.random.default_rng(plan.unit_seed)
    grasp_rng, load_rng, rng = np.random.default_rng(plan.seed).spawn(3)
    day, sensor = plan.day_draw, recipe.sensor
    grasp = draw_grasp(recipe.nuisances, day=day, wet=plan.condition == "wet", rng=grasp_rng)
    loading = load_grasp(grasp, frames=plan.frames, rng=load_rng, release=recipe.release, pulls=recipe.pulls)
    if change is not None:
        loading = change(loading)
    unit = draw_unit(recipe.nuisances, markers=sensor.geometry.markers, rng=unit_rng)
    displacement = recipe.resolved_displacement
    film = prepare_film(
        sensor, loading=loading, grasp=grasp, day=day, unit=unit, rng=rng, noise=sensor.noise, displacement=displacement
    )
    return loading, move_camera(film, recipe.nuisances, rng=rng)


def simulate_trial(
    plan: TrialPlan, *, device: str | torch.device = "cpu", on_progress: OnProgress | None = None
) -> Recording:
    """Simulate one trial."""
    loading, film = prepare_trial(plan)
    reference = film.draw_reference(device=device).cpu().numpy()
    frames = np.empty((plan.frames, *reference.shape), dtype=np.uint8)
    contact_map = np.empty(frames.shape[:3], dtype=np.uint8)
    for part in batches(plan.frames, device=device):
        frames[part] = film.draw(part, device=device).cpu().numpy()
        contact_map[part] = film.contact_map(part)
        if on_progress is not None:
            on_progress(part.stop, plan.frames)
    return Recording(
        trial=plan.trial,
        sensor=f"{plan.recipe.sensor.name}-{plan.unit + 1}",
        day=plan.day,
        condition=plan.condition,
        reference=reference,
        frames=frames,
        **{name: getattr(loading, name) for name in (*SIGNALS, "contact_state")},
        truth=GroundTruth(
            recipe=plan.recipe_hash,
            displacement=plan.recipe.resolved_displacement,
            marker_rest_px=film.marker_rest_px.astype(np.float32),
            marker_px=film.marker_px.astype(np.float32),
            static_friction=loading.static_friction,
            contact_radius_m=film.motion.contact_radius_m,
            stick_radius_m=film.motion.stick_radius_m,
            contact_map=contact_map,
        ),
    )


def simulate_examples(
    recipe: SimulationRecipe, *, device: str | torch.device = "cpu", on_progress: OnProgress | None = None
) -> list[Recording]:
    """Simulate four trials at most that show the range of a recipe, a wet one last."""
    plans = plan_trials(recipe)
    dry = [plan for plan in plans if plan.condition == "dry"]
    wet = [plan for plan in plans if plan.condition == "wet"][:1]
    shown = min(4 - len(wet), len(dry))
    chosen = [dry[index * (len(dry) - 1) // max(1, shown - 1)] for index in range(shown)] + wet
    return [simulate_trial(plan, device=device) for plan in counted(chosen, on_progress)]


def simulate(
    out: Path | str | None = None,
    *,
    preset: str = "small",
    sensor: str | None = None,
    device: str = "cpu",
    overwrite: bool = False,
    on_progress: OnProgress | None = None,
    **changes: Any,
) -> Dataset:
    """Simulate a data set of labelled trials.

    Interrupted, it goes on after the last whole trial when it is called again with the same `out`.

    Parameters
    ----------
    out
        Folder to write; a temporary one that lives as long as what is returned if None.
    preset, sensor, changes
        As `make_recipe` takes them: `preset="small"` is made for a laptop, `"thesis"` has the days and frames of the
        thesis; `pulls="varied"` makes no pull like another; `dry_trials`, `wet_trials`, `days`, `frames_per_trial` or
        `seed` change it.
    device
        Where to draw the frames: cpu, cuda or cuda:1. A GPU's pixels may differ by one grey level.

    Raises
    ------
    InputError
        If the recipe cannot be followed, the device is not there, or the folder holds something else.
    """
    require_device(device)
    recipe = make_recipe(preset, sensor=sensor, **changes)
    if out is None:
        with ExitStack() as stack, stage(on_progress, "Simulating frames") as count:
            folder = stack.enter_context(scratch_folder())
            data = simulate_dataset(folder, recipe, device=device, on_progress=count)
            weakref.finalize(data, stack.pop_all().close)
        return data
    out, config = Path(out), {"recipe": recipe.told, "device": device}
    with output_folder(out, stage="simulate", config=config, overwrite=overwrite) as output:
        if not output.complete:
            with stage(on_progress, "Simulating frames") as count:
                simulate_dataset(output.folder, recipe, device=device, on_progress=count)
    data = load_dataset(out)
    written = f"{number_of(len(data.trials), 'trial')}, {number_of(data.frames, 'frame')}"
    wrote(on_progress, out, written, kept=output.complete)
    return data


def simulate_dataset(
    folder: Path, recipe: SimulationRecipe, *, device: str | torch.device = "cpu", on_progress: OnProgress | None = None
) -> Dataset:
    """Simulate `trials/*.parquet` and, last, `dataset.json` into a folder; trials that are already there are kept.

    Raises
    ------
    InputError
        If a trial that is there was made by another recipe.
    """
    plans = plan_trials(recipe)
    total = sum(plan.frames for plan in plans)
    table, done = [], 0

    def report(drawn: int, _: int) -> None:
        if on_progress is not None:
            on_progress(done + drawn, total)

    for plan in plans:
        path = trial_path(folder, plan.trial)
        if path.is_file():
            truth = read_header(path).truth
            if truth is None or truth.recipe != plan.recipe_hash:
                raise InputError(f"{path} was made by another recipe; choose another folder")
        else:
            save_recording(simulate_trial(plan, device=device, on_progress=report), path)
        table.append(trial_info(path, split=plan.split))
        done += plan.frames
        report(0, 0)
    write_dataset_table(folder, table, simulated=True)
    return load_dataset(folder)


class SimulatedFrame(NamedTuple):
    """A frame and its labels, as tensors that a loader can stack."""

    frame: Tensor
    """uint8, (height, width, 3)."""
    reference: Tensor
    """The untouched sensor, the same."""
    safety_margin: Tensor
    """float32; NaN without contact."""
    stick_ratio: Tensor
    normal_force_n: Tensor
    tangential_force_n: Tensor
    friction_coefficient: Tensor


class SimulatedFrames(TorchDataset[SimulatedFrame]):
    """Frames of planned trials, trial after trial, the same bytes as `simulate_dataset` stores.

    Parameters
    ----------
    plans
        Trials from `plan_trials`: those of one split, for instance.
    device
        Where to draw; frames and labels are there.
    kept_trials
        How many trials stay ready to be drawn (some 10 MB each). Frames in random order over more trials than that
        cost the preparation of a trial each.
    """

    def __init__(
        self, plans: Sequence[TrialPlan], *, device: str | torch.device = "cpu", kept_trials: int = 64
    ) -> None:
        self.plans = tuple(plans)
        self.device = device
        self.kept_trials = kept_trials
        self._ends = np.cumsum([plan.frames for plan in self.plans])
        self._ready: OrderedDict[int, tuple[Loading, Film, Tensor]] = OrderedDict()

    def __len__(self) -> int:
        return int(self._ends[-1]) if len(self._ends) else 0

    def __getitem__(self, index: int) -> SimulatedFrame:
        """Draw one frame; there is an `IndexError` if there are fewer."""
        if not -len(self) <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        index %= len(self)
        trial = int(np.searchsorted(self._ends, index, side="right"))
        number = index - int(self._ends[trial]) + self.plans[trial].frames
        loading, film, reference = self._prepare(trial)
        # what follows the two images is named as in the loading
        labels = (
            torch.tensor(getattr(loading, name)[number], dtype=torch.float32, device=self.device)
            for name in SimulatedFrame._fields[2:]
        )
        return SimulatedFrame(film.draw(slice(number, number + 1), device=self.device)[0], reference, *labels)

    def _prepare(self, trial: int) -> tuple[Loading, Film, Tensor]:
        """Give a trial ready to be drawn; the one not used for longest makes room."""
        if trial not in self._ready:
            loading, film = prepare_trial(self.plans[trial])
            self._ready[trial] = (loading, film, film.draw_reference(device=self.device))
            while len(self._ready) > self.kept_trials:
                self._ready.popitem(last=False)
        self._ready.move_to_end(trial)
        return self._ready[trial]
