"""Records of what a network should have looked at, which only a simulation tells."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int

from sliplens.intervals import Difference
from sliplens.results.records import Run

REGIONS = ("markers", "slip_annulus", "edges")


@dataclass(frozen=True, kw_only=True)
class Localisation:
    """Where a method's relevance lies (share of its mass, share of its strongest pixels, by `REGIONS`), and how well it
    ranks the markers as the network's answer and the true margin do.
    """

    mass: dict[str, float | None]
    rank: dict[str, float | None]
    spearman_network: float | None
    spearman_margin: float | None
    network: Difference | None
    """Interval of `spearman_network`."""
    margin: Difference | None
    """Interval of `spearman_margin`."""
    edges: Difference | None
    """Mass on the edges of markers less the share of the image that they cover."""


@dataclass(frozen=True, kw_only=True)
class MetaTest:
    """Whether a score ranks a perfect map above a damaged one above chance, under one fill."""

    fill: str
    holds: bool
    oracle: float
    degraded: float
    random: float


@dataclass(frozen=True, kw_only=True)
class Effects:
    """What putting one marker back does to the network's answer and to the true margin, a row a marker and frame."""

    frame_id: np.ndarray
    trial: np.ndarray
    marker: Int[np.ndarray, " rows"]
    x_px: Float64[np.ndarray, " rows"]
    y_px: Float64[np.ndarray, " rows"]
    network: Float64[np.ndarray, " rows"]
    margin: Float64[np.ndarray, " rows"]
    state: Int[np.ndarray, " rows"]


@dataclass(frozen=True, kw_only=True)
class Truth:
    """What a network should have looked at, which only a simulation tells."""

    run: Run
    input: str
    source: str
    frames: int
    areas: dict[str, float | None]
    methods: dict[str, Localisation]
    network_against_margin: Difference | None
    meta: tuple[MetaTest, ...]
    told: str
    effects: Effects
    frame_ids: tuple[str, ...]
    network_maps: Float[np.ndarray, "frames height width"]
    margin_maps: Float[np.ndarray, "frames height width"]
