"""How far the simulated ChromaTouch is from the real one, on the published difference images.

The trial of the images is simulated with the fitted defaults of `Grasp` and compared frame by frame. Markers are
compared with `measured_markers.csv` after tracking the simulated images by the table's own method (`realism.markers`).
The colours are those of the lobes (what a marker uncovered or covered), of the orange rim round them and of the
background; the pixels of each come from the geometry of the simulated markers (`realism.measures.regions`).
"""

import argparse
import json
import os
from pathlib import Path

import numpy as np

from realism.markers import fit_crescents, read_table, rms, track
from realism.measures import (
    background_noise,
    colour_errors,
    correlations,
    lag_correlations,
    radial_profile,
    regions,
    top_over_bottom,
)
from realism.picture import Tracks, draw
from realism.scene import PUBLISHED, SEEN, Simulated, read_real, simulate

_TABLE_FRAMES = slice(1, None)
"""The simulated frames of the table's labels: all in contact."""
_SEEN_LABELS = [index - 1 for index in SEEN]


def compare_images(real: np.ndarray, simulated: Simulated) -> dict[str, float]:
    """Compare all but the markers; the worst frame counts unless the name says otherwise.

    The frame before contact is left out: in the real one the object already touches the apex.
    """
    contact, ours = real[1:], simulated.images[SEEN]
    correlation = correlations(contact, ours)
    colours = colour_errors(contact, simulated, SEEN)
    profile = radial_profile(contact)
    profile_error = np.sqrt(np.mean((radial_profile(ours) - profile) ** 2, axis=1)) / profile.mean(axis=1)
    lags, spreads = [], []
    for one, index in zip(contact, SEEN, strict=True):
        background = regions(simulated, index)["background"]
        noises = [background_noise(image, background) for image in (one, simulated.images[index])]
        lags.append(np.abs(np.subtract(*(lag_correlations(noise, background) for noise in noises))).max())
        spreads.append(noises[1][background].std() / noises[0][background].std() - 1)
    return {
        "correlation": float(correlation.mean()),
        "correlation_worst": float(correlation.min()),
        "mean_intensity_error": float(np.abs(ours.mean(axis=(1, 2, 3)) / contact.mean(axis=(1, 2, 3)) - 1).max()),
        "top_bottom_error": float(np.abs(top_over_bottom(ours) - top_over_bottom(contact)).max()),
        "colour_error_levels": float(max(np.abs(errors).max() for errors in colours.values())),
        **{f"colour_error_{name}": float(np.abs(errors).max()) for name, errors in colours.items()},
        "radial_profile_error": float(profile_error.max()),
        "noise_correlation_error": float(max(lags)),
        "noise_spread_error": float(np.abs(spreads).max()),
    }


def compare_markers(real: np.ndarray, tracks: Tracks) -> dict[str, float]:
    """Compare the markers with the table, and with freer fits to the images.

    `marker_rms_px` tracks simulated and real images alike; `marker_rms_untracked_px` sets the simulated markers' true
    motion against the table, and so holds the table's own error; `marker_rms_crescents_px` sets the true motion against
    the freer fit; `table_rms_crescents_px` does so for the table; `tracking_rms_px` says whether tracking the real
    images gives the table again.
    """
    table = tracks.table
    kept, measured = table.reliable, table.displacement_px
    seen, true_px = kept[_SEEN_LABELS], tracks.true_px[_SEEN_LABELS]
    crescents = fit_crescents(real[1:], table.rest_px, true_px)
    return {
        "marker_rms_px": rms((tracks.simulated_px - measured)[kept]),
        "marker_rms_untracked_px": rms((tracks.true_px - measured)[kept]),
        "marker_rms_crescents_px": rms((true_px - crescents)[seen]),
        "table_rms_crescents_px": rms((measured[_SEEN_LABELS] - crescents)[seen]),
        "tracking_rms_px": rms((track(real[1:], table.rest_px) - measured[_SEEN_LABELS])[seen]),
    }


def follow_markers(simulated: Simulated, folder: Path) -> Tracks:
    """Track the simulated images, and pick the true motion of the same markers."""
    table = read_table(folder)
    nearest = np.argmin(np.linalg.norm(table.rest_px[:, None] - simulated.rest_px, axis=-1), axis=1)
    motion = simulated.centres_px[_TABLE_FRAMES] - simulated.rest_px
    return Tracks(
        table=table,
        simulated_px=track(simulated.images[_TABLE_FRAMES], table.rest_px),
        true_px=motion[:, nearest],
    )


def print_table(real: np.ndarray, simulated: Simulated, numbers: dict[str, float]) -> None:
    """Print what was compared, frame by frame and in all."""
    ours = simulated.images[[0, *SEEN]]
    correlation = correlations(real, ours)
    print("margin   mean: real  simulated   top/bottom: real  simulated   correlation")
    for index, margin in enumerate(PUBLISHED.values()):
        print(
            f"{margin:6.2f} {real[index].mean():12.2f} {ours[index].mean():10.2f} "
            f"{top_over_bottom(real)[index]:18.2f} {top_over_bottom(ours)[index]:10.2f} {correlation[index]:13.3f}"
        )
    print("\nmargin   simulated less real colour (R G B): lobes, rim, background")
    errors = colour_errors(real[1:], simulated, SEEN)
    for margin, *colours in zip(list(PUBLISHED.values())[1:], *errors.values(), strict=True):
        print(f"{margin:6.2f}   " + "  |".join("".join(f"{level:7.1f}" for level in colour) for colour in colours))
    print()
    for name, value in numbers.items():
        print(f"{name:26s} {value:.3f}")


def main() -> None:
    """Compare, print, and draw if asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true", help="print one JSON object as the last line")
    parser.add_argument("--out", type=Path, help="PNG to write: real above simulated, and charts")
    parser.add_argument("--seed", type=int, default=0, help="of the camera's noise")
    arguments = parser.parse_args()
    folder = Path(os.environ.get("SLIPLENS_REFERENCE", "../shared/reference")) / "chromatouch"
    real, simulated = read_real(folder), simulate(arguments.seed)
    tracks = follow_markers(simulated, folder)
    numbers = compare_images(real, simulated) | compare_markers(real, tracks)
    print_table(real, simulated, numbers)
    if arguments.out is not None:
        draw(arguments.out, real=real, simulated=simulated, tracks=tracks)
    if arguments.json:
        print(json.dumps(numbers))


if __name__ == "__main__":
    main()
