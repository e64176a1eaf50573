"""Scores of several studies together: what holds for other networks, days and trials than those of one."""

from collections.abc import Iterable, Sequence
from typing import TypeAlias

import numpy as np

from sliplens.errors import InputError
from sliplens.faithfulness.controls import lead_over_controls
from sliplens.intervals import mean_interval
from sliplens.results.faithfulness import is_control
from sliplens.results.study import PooledScore, PooledScores, Study
from sliplens.study.truth import mean_of_defined, rank_correlation

_Measured: TypeAlias = tuple[np.ndarray, np.ndarray]
"""A score of each frame, and the networks, days and trials of the frames, a row a level."""


def pool_studies(studies: Sequence[Study], *, seed: int = 0) -> PooledScores:
    """Score the methods over several networks: studies of the same frames, each with networks of another seed.

    What one network's study calls better may be so for that network alone. Here intervals hold for other networks too,
    of which three or more are needed to say much. Networks are told apart by their weights, and trials by their names,
    which studies of one data set share. Settings and methods that not all studies have are left out.

    Raises
    ------
    InputError
        If there is no study, or no input on which all have scores.

    Examples
    --------
    >>> from sliplens.study import pool_studies, run_study
    >>> seeds = [f"runs/mine/network-{seed}" for seed in range(3)]
    >>> studies = [run_study("runs/mine/data", run) for run in seeds]  # doctest: +SKIP
    >>> pool_studies(studies).frame().to_pandas()  # doctest: +SKIP
    """
    inputs = set.intersection(*({*study.faithfulness} & {*study.explanations} for study in studies)) if studies else ()
    if not inputs:
        raise InputError("no input has scores in every study; give studies that explained and scored the same input")
    return PooledScores(scores=tuple(score for name in sorted(inputs) for score in _pool(name, studies, seed=seed)))


def _pool(name: str, studies: Sequence[Study], *, seed: int) -> list[PooledScore]:
    shared = set.intersection(*({*study.faithfulness[name].curves} for study in studies))
    explained = set.intersection(*({*study.explanations[name].methods} for study in studies))
    simulated = all(name in study.truth for study in studies)
    truth = {method: _join(_with_truth(study, name, method) for study in studies) for method in explained if simulated}
    pooled = []
    for fill, unit in dict.fromkeys(key[:2] for key in studies[0].faithfulness[name].curves if key in shared):
        methods = [method for *setting, method in sorted(shared) if setting == [fill, unit]]
        found = {method: _join(_gains(study, name, (fill, unit, method)) for study in studies) for method in methods}
        controls = {method: gains for method, (gains, _) in found.items() if is_control(method)}
        for method, (gains, clusters) in found.items():
            gain = mean_interval(gains, clusters=clusters, rng=np.random.default_rng(seed))
            rng = np.random.default_rng(seed)
            lead = None if method in controls else lead_over_controls(gains, controls, clusters=clusters, rng=rng)
            held = mean_of_defined(*truth[method], seed=seed, limits=(-1.0, 1.0)) if method in truth else None
            pooled.append(
                PooledScore(input=name, fill=fill, unit=unit, method=method, gain=gain, lead=lead, truth=held)
            )
    return pooled


def _gains(study: Study, name: str, key: tuple[str, str, str]) -> _Measured:
    curve, network = study.faithfulness[name].curves[key], study.explanations[name].weights_sha256
    return curve.srg, np.stack([np.repeat(network, len(curve.srg)), *curve.clusters])


def _with_truth(study: Study, name: str, method: str) -> _Measured:
    """Signed rank correlation, frame by frame, of a map's means over the markers with their Shapley values."""
    explained, truth = study.explanations[name], study.truth[name]
    rows = {frame.id: row for row, frame in enumerate(explained.frames)}
    chosen = explained.take([rows[frame] for frame in truth.frame_ids])
    correlations = []
    for values, painted in zip(chosen.relevance[method], truth.shapley_maps, strict=True):
        # a marker's pixels have its value, which no other has; 0 lies beside them all
        effects, marker = np.unique(painted, return_inverse=True)
        means = np.bincount(marker.ravel(), weights=values.ravel()) / np.bincount(marker.ravel())
        correlations.append(rank_correlation(effects[effects != 0], means[effects != 0]))
    return np.array(correlations), np.stack([np.repeat(explained.weights_sha256, len(chosen.frames)), *chosen.clusters])


def _join(parts: Iterable[_Measured]) -> _Measured:
    values, clusters = zip(*parts, strict=True)
    return np.concatenate(values), np.concatenate(clusters, axis=1)
