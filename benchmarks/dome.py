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
"""

import argparse
import csv
import json
import os
from pathlib import Path

import numpy as np

from sliplens.images import read_image
from sliplens.markers import calibrate_traction, track_markers
from sliplens.recordings import import_recordings
from sliplens.recordings.formats.tables import open_text_table
from sliplens.recordings.options import LabelSettings
from sliplens.training import evaluate, train

LIGHT_G, HEAVY_G = 135.6, 584.2
TEN_TILTS = (0, 0), (15, 0), (0, -30), (-15, -15), (-30, 30)
"""Tilts about x and z, in degrees, of five training states for each mass: every F_t / F_n that occurs, once."""


def read_states(folder: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean displacement of the markers by state in pixels, forces (shear x, z, normal) in newtons, mass and tilts."""
    table = open_text_table(folder / "states.csv")
    rows = [dict(zip(table.header, cells, strict=True)) for _, cells in table.rows]
    states = np.array([[float(row[name]) for name in ("mass_g", "tilt_x_deg", "tilt_z_deg")] for row in rows])
    force_n = np.array([[float(row[name]) for name in ("shear_x_n", "shear_z_n", "normal_n")] for row in rows])
    frames = [read_image(folder / row["file"]) for row in rows]
    untouched = states[:, 0] == 0
    moved_px = track_markers(frames, frames[int(np.flatnonzero(untouched)[0])]).displacement_px
    moved_px = moved_px - np.nanmean(moved_px[untouched], axis=0)
    kinds, number = np.unique(states[~untouched], axis=0, return_inverse=True)
    means, forces = [], []
    for kind in range(len(kinds)):
        of = np.flatnonzero(~untouched)[number.ravel() == kind]
        seen = np.isfinite(moved_px[of]).all(axis=2).mean(axis=0) >= 0.5
        means.append(np.where(seen[:, None], np.nanmean(np.where(seen[:, None], moved_px[of], 0), axis=0), np.nan))
        forces.append(force_n[of[0]])
    return np.stack(means), np.stack(forces), kinds


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
    moved_px, force_n, states = read_states(options.data)
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
