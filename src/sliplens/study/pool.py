"""Scores of several studies together: what holds for other networks, days and trials than those of one."""

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from jaxtyping import Float, Shaped
from scipy.stats import spearmanr

from sliplens.errors import InputError
from sliplens.faithfulness.controls import lead_over_controls
from sliplens.intervals import Difference, paired_difference
from sliplens.results.faithfulness import Key, RemovalScores, is_control
from sliplens.results.study import PooledScore, PooledScores, Study

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
    >>> studies = [run_study("runs/mine/data", difference=run, raw=None) for run in seeds]  # doctest: +SKIP
    >>> pool_studies(studies).frame().to_pandas()  # doctest: +SKIP
    """
    inputs = set.intersection(*({*study.faithfulness} & {*study.explanations} for study in studies)) if studies else ()
    if not inputs:
        raise InputError("no input has scores in every study; give studies that explained and scored the same input")
    rng = np.random.default_rng(seed)
    return PooledScores(scores=tuple(score for name in sorted(inputs) for score in _pool(name, studies, rng=rng)))


def _pool(name: str, studies: Sequence[Study], *, rng: np.random.Generator) -> list[PooledScore]:
    scored = [(study.explanations[name].weights_sha256, study.faithfulness[name]) for study in studies]
    truth = {
        method: _join([_with_truth(study, name, method) for study in studies])
        for method in set.intersection(*({*study.explanations[name].methods} for study in studies))
        if all(name in study.truth for study in studies)
    }
    shared = set.intersection(*({*own.curves} for _, own in scored))
    pooled = []
    for setting in dict.fromkeys(key[:2] for key in scored[0][1].curves if key in shared):
        found = {key[2]: _join([_gains(*one, key) for one in scored]) for key in sorted(shared) if key[:2] == setting}
        controls = {method: gains for method, (gains, _) in found.items() if is_control(method)}
        for method, (gains, clusters) in found.items():
            pooled.append(
                PooledScore(
                    input=name,
                    fill=setting[0],
                    unit=setting[1],
                    method=method,
                    gain=paired_difference(gains, 0 * gains, clusters=clusters, rng=rng),
                    lead=None
                    if method in controls
                    else lead_over_controls(gains, controls, clusters=clusters, rng=rng),
                    truth=_mean(*truth[method], rng=rng) if method in truth else None,
                )
            )
    return pooled


def _gains(network: str, scores: RemovalScores, key: Key) -> _Measured:
    curve = scores.curves[key]
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
        means = np.bincount(marker.ravel(), weights=values.ravel().astype(np.float64)) / np.bincount(marker.ravel())
        seen = effects != 0
        varies = seen.sum() > 1 and np.ptp(means[seen]) > 0
        correlations.append(float(np.asarray(spearmanr(effects[seen], means[seen]))[0]) if varies else np.nan)
    return np.array(correlations), np.stack([np.repeat(explained.weights_sha256, len(chosen.frames)), *chosen.clusters])


def _join(parts: Sequence[_Measured]) -> _Measured:
    values, clusters = zip(*parts, strict=True)
    return np.concatenate(values), np.concatenate(clusters, axis=1)


def _mean(
    values: Float[np.ndarray, " frames"], clusters: Shaped[np.ndarray, "3 frames"], *, rng: np.random.Generator
) -> Difference | None:
    known = np.isfinite(values)
    values = values[known]
    return paired_difference(values, 0 * values, clusters=clusters[:, known], rng=rng) if len(values) else None
