"""What each marker of a frame does to the network and to the best reading, and which fills can tell."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float
from torch import Tensor

from sliplens.faithfulness import get_fill
from sliplens.faithfulness.answering import Predict, answer_whole
from sliplens.faithfulness.removal import RemovalCurves, removal_curves
from sliplens.faithfulness.true_fill import SHARES, Redraw, influence_orders, marker_curves
from sliplens.faithfulness.units import unit_order
from sliplens.simulation.best_reading import marker_readings
from sliplens.study.saved import MAPS_FILE
from sliplens.study.truth_scenes import Places, StagedFrame

TRUE_FILL = "true"
EFFECTS_FILE = "effects.parquet"
EFFECTS = ("network", "margin")
"""What putting a marker back changes."""
ORACLE, DEGRADED = "oracle", "degraded-oracle"


@dataclass(frozen=True, kw_only=True)
class MarkerEffects:
    """What each marker of a frame does, in margin units: the value as it is less the value with the marker put back.

    Attributes
    ----------
    network
        Of the network's answer.
    margin
        Of the margin as the best reader of markers reads it (`simulation.best_reading`).
    shuffled
        The network's, those of half of the markers shuffled: an oracle that is half wrong.
    gains
        Symmetric gain, under each fill, of the map that has `network` and of the one that has `shuffled`: a row for
        changes by their size, as `Faithfulness` has them, and one for changes counted towards the target.
    """

    network: Float[np.ndarray, " markers"]
    margin: Float[np.ndarray, " markers"]
    shuffled: Float[np.ndarray, " markers"]
    gains: Mapping[str, Float[np.ndarray, "2 2"]]


def network_effects(predict: Predict, redraw: Redraw, image: int, *, markers: int) -> Float[np.ndarray, " markers"]:
    """What the network's answer loses when each marker alone is put back, in margin units.

    Parameters
    ----------
    predict, redraw
        The network, and what draws the image.
    image, markers
        Number of the image, and of the markers in it.
    """
    # the whole image first
    back = np.eye(markers + 1, markers, k=-1, dtype=bool)
    answers = answer_whole(predict, redraw(image, back), batch_size=64)
    return answers[0] - answers[1:]


def shuffle_half(values: Float[np.ndarray, " markers"], *, rng: np.random.Generator) -> Float[np.ndarray, " markers"]:
    """Shuffle the values of half of the markers among themselves."""
    chosen = rng.permutation(len(values))[: len(values) // 2]
    shuffled = values.copy()
    shuffled[chosen] = values[rng.permutation(chosen)]
    return shuffled


def find_effects(
    predict: Predict,
    redraw: Redraw,
    image: int,
    frame: StagedFrame,
    places: Places,
    *,
    inputs: Float[Tensor, "1 3 size size"],
    references: Float[Tensor, "1 3 size size"],
    towards: float,
    fills: Sequence[str],
    rng: np.random.Generator,
) -> MarkerEffects:
    """Put every marker of a frame back, and see which fills can tell a map that knows its effects from half of one.

    Parameters
    ----------
    predict, redraw
        The network, and what draws the image.
    image
        Number of the frame, as `redraw` takes it.
    frame, places
        The frame, and where its markers are.
    inputs, references
        The frame as the network gets it, and the untouched sensor.
    towards
        Sign of the answer's change from the untouched sensor: what works towards it goes first.
    fills
        Names of fills; the true one is always there.
    rng
        Source of the shuffling.
    """
    network = network_effects(predict, redraw, image, markers=len(frame.markers))
    shuffled = shuffle_half(network, rng=rng)
    known = [towards * network, towards * shuffled]
    orders = [
        unit_order(places.paint(one), places.units, least_first=least) for one in known for least in (False, True)
    ]
    curves = {
        name: removal_curves(
            predict,
            inputs,
            np.stack(orders)[:, None],
            fill=get_fill(name),
            references=references,
            areas=SHARES,
        )
        for name in fills
    }
    curves[TRUE_FILL] = marker_curves(
        predict, lambda _, back: redraw(image, back), np.concatenate([influence_orders(one[None]) for one in known])
    )
    return MarkerEffects(
        network=network,
        margin=marker_readings(frame.scene, frame.number)[1],
        shuffled=shuffled,
        gains={name: _gains(found, towards) for name, found in curves.items()},
    )


def _gains(curves: RemovalCurves, towards: float) -> Float[np.ndarray, "2 2"]:
    """Symmetric gains of two maps, each removed both ways, by the size of the changes and by their part `towards`."""
    means = np.empty((2, len(curves.answers)))
    means[0] = curves.mean_changes[:, 0]
    means[1] = np.trapezoid(towards * (curves.answers[:, 0, :1] - curves.answers[:, 0]), curves.areas, axis=-1)
    return means[:, ::2] - means[:, 1::2]


def save_effects(path: Path, effects: MarkerEffects) -> None:
    """Write the effects of a frame, beside the target first."""
    hidden = path.with_suffix(".part.npz")
    np.savez(
        hidden,
        allow_pickle=False,
        network=effects.network,
        margin=effects.margin,
        shuffled=effects.shuffled,
        fills=np.array(list(effects.gains), dtype=np.str_),
        gains=np.stack(list(effects.gains.values())),
    )
    hidden.replace(path)


def load_effects(path: Path) -> MarkerEffects:
    """Read what `save_effects` wrote."""
    with np.load(path, allow_pickle=False) as archive:
        return MarkerEffects(
            network=archive["network"],
            margin=archive["margin"],
            shuffled=archive["shuffled"],
            gains=dict(zip(archive["fills"].tolist(), archive["gains"], strict=True)),
        )


def write_effects(
    folder: Path, frames: Sequence[StagedFrame], places: Sequence[Places], effects: Sequence[MarkerEffects]
) -> None:
    """Write the effects of all frames as a table, and painted on the markers."""
    tables = [
        pa.table(
            {
                "frame_id": [frame.id] * len(frame.markers),
                "trial": [frame.trial] * len(frame.markers),
                "safety_margin": np.full(len(frame.markers), frame.safety_margin),
                "marker": frame.markers.astype(np.int64),
                "x_px": one.now_px[:, 0],
                "y_px": one.now_px[:, 1],
                "network_effect": found.network,
                "margin_effect": found.margin,
                "state": one.state,
            }
        )
        for frame, one, found in zip(frames, places, effects, strict=True)
    ]
    pq.write_table(pa.concat_tables(tables), folder / EFFECTS_FILE)
    maps = {
        effect: np.stack([one.paint(getattr(found, effect)) for one, found in zip(places, effects, strict=True)])
        for effect in EFFECTS
    }
    np.savez_compressed(
        folder / MAPS_FILE, allow_pickle=False, **{name: values.astype(np.float32) for name, values in maps.items()}
    )
