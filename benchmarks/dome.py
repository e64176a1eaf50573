"""Traction of a real dome from its markers, calibrated by known loads and asked about others.

The frames are those of FingerVision (UM-FingerVision, 45 load states of a white dome with 29 dots): a weight presses on
the dome through a rig that is tilted about two axes. Repeats of a state are averaged: they tell noise, not another
mounting. Every number is of states that the calibration never saw.

- `traction_r2`, `direction_deg_median`, `ratio_mae`: calibrated on 135.6 g and vertical loads, asked about 584.2 g
  under tilt; the load is taken from the markers. `load_given` has it measured, as a gripper does; `five_states` is
  calibrated on four tilts of 135.6 g and 1011.3 g alone. `ridge` is a ridge of forces on raw displacements, the best
  of three penalties on the states asked about: what the model has to beat.
- `adapted_r2` (with --adapt): R2 of F_t / F_n by a network, means over the repeats of a state, on tilts that its
  training never saw. Friction is set to 1, so that the margin is 1 - F_t / F_n. `ten` trains on ten states (five
  tilts of both masses); `mass`, `tilt` and `direction` leave out each of two halves in
  turn. Of each training state two repeats of ten are held out to stop the training.
- `leave_out`: one mass, tilt or direction left out of both masses, the others calibrate.
- `sim_vs_real`: the simulator's dome with the dots of this one. Its lens and stiffness are fitted to the vertical loads
  from 584 g, all else of its motion is that of the ChromaTouch. Correlation of simulated and real displacements
  (all dots, both coordinates), of a press as such and, under tilt, of what differs from the press of the same mass; how
  many times as large the real motion is; and the power of the load with which the dots spread.
- `health`: share of the frames that each check of live readings withholds.
"""

import argparse
import csv
import json
import os
import time
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np

from sliplens.images import read_image
from sliplens.live.health import HealthMonitor
from sliplens.live.reading import LiveFrame
from sliplens.markers import calibrate_traction, track_markers
from sliplens.markers.estimators import affine_parts
from sliplens.markers.tracker import Tracker
from sliplens.recordings import import_recordings
from sliplens.recordings.formats.tables import open_text_table
from sliplens.recordings.options import LabelSettings
from sliplens.simulation.loading import load_at_states, move_markers
from sliplens.simulation.nuisances import Grasp
from sliplens.simulation.sensor import CHROMATOUCH, Dome
from sliplens.training import evaluate, train

LIGHT_G, HEAVY_G = 135.6, 584.2
CENTRE_PX = 152.0, 125.0  # middle of the dome in the picture
TEN_TILTS = (0, 0), (15, 0), (0, -30), (-15, -15), (-30, 30)
"""Tilts about x and z, in degrees, of five training states for each mass: every F_t / F_n that occurs, once."""


def read_states(folder: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Mean displacement of the markers by state in pixels, forces (shear x, z, normal) in newtons, mass and tilts.

    The last are the places of the markers at rest.
    """
    table = open_text_table(folder / "states.csv")
    rows = [dict(zip(table.header, cells, strict=True)) for _, cells in table.rows]
    states = np.array([[float(row[name]) for name in ("mass_g", "tilt_x_deg", "tilt_z_deg")] for row in rows])
    force_n = np.array([[float(row[name]) for name in ("shear_x_n", "shear_z_n", "normal_n")] for row in rows])
    frames = [read_image(folder / row["file"]) for row in rows]
    untouched = states[:, 0] == 0
    tracks = track_markers(frames, frames[int(np.flatnonzero(untouched)[0])])
    moved_px = tracks.displacement_px
    moved_px = moved_px - np.nanmean(moved_px[untouched], axis=0)
    kinds, number = np.unique(states[~untouched], axis=0, return_inverse=True)
    means, forces = [], []
    for kind in range(len(kinds)):
        of = np.flatnonzero(~untouched)[number.ravel() == kind]
        seen = np.isfinite(moved_px[of]).all(axis=2).mean(axis=0) >= 0.5
        means.append(np.where(seen[:, None], np.nanmean(np.where(seen[:, None], moved_px[of], 0), axis=0), np.nan))
        forces.append(force_n[of[0]])
    return np.stack(means), np.stack(forces), kinds, tracks.rest_px


def compare(vector: np.ndarray, force_n: np.ndarray) -> dict[str, object]:
    """R2 of both components, median error of the direction of tilted states, mean error of the ratio."""
    truth = force_n[:, :2] / force_n[:, 2:]
    error = ((vector - truth) ** 2).sum(axis=0)
    tilted = np.linalg.norm(truth, axis=1) > 0
    turn = np.degrees(np.angle((vector[tilted] @ [1, 1j]) / (truth[tilted] @ [1, 1j])))
    return {
        "traction_r2": (1 - error / ((truth - truth.mean(axis=0)) ** 2).sum(axis=0)).tolist(),
        "direction_deg_median": float(np.median(np.abs(turn))),
        "ratio_mae": float(np.abs(np.linalg.norm(vector, axis=1) - np.linalg.norm(truth, axis=1)).mean()),
        "states": len(truth),
    }


def ask(moved_px: np.ndarray, force_n: np.ndarray, known: np.ndarray, asked: np.ndarray, *, given: bool) -> np.ndarray:
    """Traction vectors of some states from a calibration on others."""
    model = calibrate_traction(moved_px[known], force_n[known])
    return model.measure(moved_px[asked], force_n[asked, 2] if given else None).vector


def ridge(moved_px: np.ndarray, force_n: np.ndarray, known: np.ndarray, asked: np.ndarray) -> dict[str, object]:
    """Ridge of forces on raw displacements, the best of three penalties."""
    values = np.nan_to_num(moved_px.reshape(len(moved_px), -1))
    found = []
    for penalty in (1.0, 10.0, 100.0):
        inner = values[known].T @ values[known] + penalty * np.eye(values.shape[1])
        guess = values[asked] @ np.linalg.solve(inner, values[known].T @ force_n[known])
        found.append(compare(guess[:, :2] / guess[:, 2:], force_n[asked]))
    return max(found, key=lambda one: float(np.mean(np.asarray(one["traction_r2"]))))


def leave_out(moved_px: np.ndarray, force_n: np.ndarray, states: np.ndarray, *, given: bool) -> dict[str, object]:
    """Scores over tilted states, each asked of a calibration that lacks its mass, tilt or direction."""
    mass, tilt = states[:, 0], states[:, 1:]
    tilted = np.flatnonzero(np.any(tilt != 0, axis=1))
    steepest, direction = np.abs(tilt).max(axis=1), np.round(np.degrees(np.arctan2(tilt[:, 1], tilt[:, 0])))
    alike = {
        "mass": lambda at: np.round(mass) == np.round(mass[at]),
        "tilt": lambda at: steepest == steepest[at],
        "direction": lambda at: (direction == direction[at]) & (steepest > 0),
    }
    return {
        name: compare(
            np.concatenate([ask(moved_px, force_n, ~same(at), np.array([at]), given=given) for at in tilted]),
            force_n[tilted],
        )
        for name, same in alike.items()
    }


def halves(states: np.ndarray) -> dict[str, list[tuple[np.ndarray, np.ndarray]]]:
    """Return the training and test states of each question, as masks over the states."""
    light, heavy = (np.abs(states[:, 0] - mass) < 0.5 for mass in (LIGHT_G, HEAVY_G))
    tilt = np.abs(states[:, 1:])
    tilted, steep, one_axis = tilt.max(axis=1) > 0, tilt.max(axis=1) == tilt.max(), tilt.min(axis=1) == 0
    ten = (light | heavy) & np.any([(states[:, 1:] == known).all(axis=1) for known in TEN_TILTS], axis=0)

    def both(half: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        return [(~asked | ~tilted, asked & tilted) for asked in (half, ~half)]

    return {"ten": [(ten, tilted & ~ten)], "mass": both(light), "tilt": both(steep), "direction": both(one_axis)}


def adapt(folder: Path, work: Path, *, start: str | None) -> dict[str, dict[str, float]]:
    """R2 and mean absolute error of F_t / F_n by networks trained on some states and asked about others."""
    with (folder / "states.csv").open(encoding="utf-8") as file:
        reader = csv.DictReader(file)
        rows, header = list(reader), list(reader.fieldnames or ())
    by_row = np.array([[float(row[name]) for name in ("mass_g", "tilt_x_deg", "tilt_z_deg")] for row in rows])
    states, number = np.unique(by_row, axis=0, return_inverse=True)
    untouched, held_out = by_row[:, 0] == 0, np.array([int(row["repeat"]) >= 8 for row in rows])
    results = {}
    for question, folds in halves(states).items():
        truth, predicted = [], []
        for fold, masks in enumerate(folds):
            known, asked = (mask[number.ravel()] & ~untouched for mask in masks)
            parts = {"train": known & ~held_out, "validation": known & held_out, "test": asked}
            place = work / f"{start or 'scratch'}-{question}-{fold}"
            for name, members in parts.items():
                (place / name).mkdir(parents=True, exist_ok=True)
                for path in folder.iterdir():
                    if path.is_dir() and not (place / name / path.name).exists():
                        (place / name / path.name).symlink_to(path.resolve())
                with (place / name / "states.csv").open("w", encoding="utf-8", newline="") as file:
                    writer = csv.DictWriter(file, header)
                    writer.writeheader()
                    writer.writerows(row for row, member in zip(rows, members | untouched, strict=True) if member)
            data = import_recordings(
                [place / name for name in parts],
                out=place / "data",
                sensor="fingervision",
                splits={name: name for name in parts},
                labelling=LabelSettings(mu=1.0),
            )
            settings = {"epochs": 20, "epoch_frames": 640, "image_size": 112, "augmentation": "all-directions"}
            recipe = "default" if start is None else "adapt"
            network = train(data, place / "run", input="pair", recipe=recipe, start_from=start, patience=20, **settings)
            table = evaluate(network, data).predictions
            recording = data.load(data.find("test"))
            ratio = recording.tangential_force_n / np.maximum(recording.normal_force_n, 1e-9)
            state = number.ravel()[np.flatnonzero(parts["test"] | untouched)]
            frame = np.asarray(table.frame)
            for kind in np.unique(state[frame]):
                of = state[frame] == kind
                truth.append(float(ratio[frame[of]].mean()))
                predicted.append(float(1 - np.asarray(table.prediction)[of].mean()))
        results[question] = score_ratios(np.array(predicted), np.array(truth))
    return results


def score_ratios(predicted: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """R2 and mean absolute error of F_t / F_n."""
    error = predicted - truth
    r2 = 1 - np.sum(error**2) / np.sum((truth - truth.mean()) ** 2)
    return {"r2": float(r2), "mae": float(np.abs(error).mean()), "states": len(truth)}


def by_markers(moved_px: np.ndarray, force_n: np.ndarray, states: np.ndarray, *, given: bool) -> dict[str, object]:
    """Scores of markers that were calibrated on the states that train the networks of `adapt`."""
    found = {}
    for question, folds in halves(states).items():
        vectors = [ask(moved_px, force_n, known, asked, given=given) for known, asked in folds]
        force = np.concatenate([force_n[asked] for _, asked in folds])
        truth = np.linalg.norm(force[:, :2], axis=1) / force[:, 2]
        found[question] = score_ratios(np.linalg.norm(np.concatenate(vectors), axis=1), truth)
    return found


@dataclass(frozen=True, kw_only=True)
class SeenDome(Dome):
    """A dome whose dots lie where they are seen."""

    seen_px: tuple[tuple[float, float], ...]

    def marker_positions(self, depth_m: float = 0.0) -> np.ndarray:
        """Places of the dots under the skin, in metres: where their lines of sight meet the sphere."""
        away = (np.array(self.seen_px) - self.centre_px) / self.focal_px_per_rad
        angle = np.linalg.norm(away, axis=1, keepdims=True)
        sight = np.concatenate([away * np.sinc(angle / np.pi), np.cos(angle)], axis=1)
        behind_m, radius_m = self.camera_offset * self.radius_m, self.radius_m - depth_m
        along = behind_m * sight[:, 2:]
        return sight * (along + np.sqrt(along**2 + radius_m**2 - behind_m**2)) - [0, 0, behind_m]


def simulate(dome: SeenDome, stiffness: float, model: str, force_n: np.ndarray) -> np.ndarray:
    """Displacements of the dots under forces (shear x, z, normal), in pixels; friction 1, under which nothing slips."""
    sensor = replace(
        CHROMATOUCH,
        geometry=dome,
        effective_modulus_pa=(CHROMATOUCH.effective_modulus_pa or 0) * stiffness,
        youngs_modulus_pa=CHROMATOUCH.youngs_modulus_pa * stiffness,
    )
    fields = []
    for x_n, z_n, normal_n in force_n:
        margin, one = np.array([1 - np.hypot(x_n, z_n) / normal_n]), np.ones(1)
        grasp = Grasp(friction=1.0, contact_offset=(0.0, 0.0), shear_direction_rad=float(np.arctan2(z_n, x_n)))
        loading = load_at_states(normal_n * one, friction=one, margins=margin)
        motion = move_markers(sensor, grasp, loading=loading, displacement=model)
        fields.append(motion.centres_px[0] - motion.rest_px)
    return np.array(fields)


def compare_motion(simulated: np.ndarray, real: np.ndarray) -> dict[str, float]:
    """Correlation about zero of two fields of displacements, and how many times as large the real one is."""
    seen = np.isfinite(real)
    one, other = simulated[seen], real[seen]
    return {
        "correlation": float(one @ other / np.sqrt(one @ one * (other @ other))),
        "real_over_simulated": float(one @ other / (one @ one)),
    }


def sim_vs_real(
    moved_px: np.ndarray, force_n: np.ndarray, states: np.ndarray, rest_px: np.ndarray
) -> dict[str, object]:
    """Compare the motion of the simulator's dome with that of the real one, by displacement model."""
    mass, tilted = states[:, 0], np.any(states[:, 1:] != 0, axis=1)
    vertical = ~tilted & (mass > HEAVY_G - 1)
    load_n, found = force_n[vertical, 2], {}
    for model, stiffnesses in (("calibrated", (12, 24, 48, 96)), ("half-space", (0.6, 1.2, 2.4, 4.8))):
        fits = []
        for focal, offset, stiffness in product((130.0, 160.0, 190.0, 230.0), (0.0, 0.2, 0.4, 0.6), stiffnesses):
            dome = SeenDome(
                radius_m=0.020, camera_offset=offset, focal_px_per_rad=focal, centre_px=CENTRE_PX,
                ring_spacing_deg=10.0, ring_counts=(1,), ring_scale=(1.0,), seen_px=tuple(map(tuple, rest_px.tolist())),
            )  # fmt: skip
            error = simulate(dome, stiffness, model, force_n[vertical]) - moved_px[vertical]
            fits.append((float(np.nansum(error**2)), focal, offset, stiffness, dome))
        _, focal, offset, stiffness, dome = min(fits, key=lambda fit: fit[0])
        pressed = simulate(dome, stiffness, model, force_n[vertical])
        spreads = [affine_parts(rest_px, field)[:, 2] for field in (pressed, moved_px[vertical])]
        powers = [float(np.polyfit(np.log(load_n), np.log(spread), 1)[0]) for spread in spreads]
        scores: dict[str, object] = {
            "focal_px_per_rad": focal,
            "camera_offset": offset,
            "stiffness": stiffness,
            "press": compare_motion(pressed, moved_px[vertical]),
            "power_of_load": {"simulated": powers[0], "real": powers[1]},
        }
        for name, grams in (("light", LIGHT_G), ("heavy", HEAVY_G)):
            of = np.abs(mass - grams) < 0.5
            press_px, press_n = np.nanmean(moved_px[of & ~tilted], axis=0), force_n[of & ~tilted].mean(axis=0)
            sheared = simulate(dome, stiffness, model, force_n[of & tilted])
            sheared = sheared - simulate(dome, stiffness, model, press_n[None])
            scores[f"shear_{name}"] = compare_motion(sheared, moved_px[of & tilted] - press_px)
        found[model] = scores
    return found


def health(folder: Path) -> dict[str, float]:
    """Share of the loaded frames that each check withholds, against the first untouched frame."""
    with (folder / "states.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    frames = {row["file"]: read_image(folder / row["file"]) for row in rows}
    untouched = next(frames[row["file"]] for row in rows if float(row["mass_g"]) == 0)
    monitor, tracker, withheld = HealthMonitor(untouched), Tracker(untouched), dict[str, int]()
    loaded = [row["file"] for row in rows if float(row["mass_g"]) > 0]
    for number, name in enumerate(loaded):
        frame = LiveFrame(image=frames[name], number=number, time_s=number / 2, captured_s=time.monotonic())
        for check in monitor.check(frame, tracker.update(frame.image)):
            withheld[check.name] = withheld.get(check.name, 0) + (not check.ok)
    return {name: count / len(loaded) for name, count in withheld.items() if count} | {"frames": len(loaded)}


def main() -> None:
    """Print what was measured as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = Path(os.environ.get("SLIPLENS_REFERENCE", "../shared/reference")) / "fingervision"
    parser.add_argument("--data", type=Path, default=default, help="folder with states.csv and its frames")
    parser.add_argument("--adapt", type=Path, metavar="FOLDER", help="train 14 networks there, about an hour")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    if not (options.data / "states.csv").is_file():
        parser.error(f"{options.data} has no states.csv; name the folder of the dome's frames with --data")
    moved_px, force_n, states, rest_px = read_states(options.data)
    tilted = np.any(states[:, 1:] != 0, axis=1)
    asked = np.abs(states[:, 0] - HEAVY_G) < 0.05
    known = ~asked & (~tilted | (np.abs(states[:, 0] - LIGHT_G) < 0.5))
    axes = np.sum(states[:, 1:] != 0, axis=1) == 1
    steep = np.abs(states[:, 1:]).max(axis=1) == np.abs(states[:, 1:]).max()
    five = (known & tilted & axes & steep) | (np.abs(states[:, 0] - 1011.3) < 0.05)
    found: dict[str, object] = {
        "calibration_states": int(known.sum()),
        **compare(ask(moved_px, force_n, known, asked, given=False), force_n[asked]),
        "load_given": compare(ask(moved_px, force_n, known, asked, given=True), force_n[asked]),
        "five_states": {
            name: compare(ask(moved_px, force_n, five, asked, given=name == "load_given"), force_n[asked])
            for name in ("markers", "load_given")
        },
        "ridge": ridge(moved_px, force_n, known, asked),
        "leave_out": leave_out(moved_px, force_n, states, given=False),
        "leave_out_load_given": leave_out(moved_px, force_n, states, given=True),
        "sim_vs_real": sim_vs_real(moved_px, force_n, states, rest_px),
        "health": health(options.data),
    }
    if options.adapt is not None:
        starts = {"chromatouch-pair": "chromatouch-pair", "scratch": None}
        found["markers"] = {
            name: by_markers(moved_px, force_n, states, given=name == "load_given")
            for name in ("markers", "load_given")
        }
        found["adapted_r2"] = {name: adapt(options.data, options.adapt, start=start) for name, start in starts.items()}
    print(json.dumps(found, indent=None if options.json else 2))


if __name__ == "__main__":
    main()
