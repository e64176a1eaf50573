"""Cramer and Rao's bound on an estimate of the margin."""

from collections.abc import Mapping

import numpy as np

from sliplens.simulation.intervention import observations


def least_sigma(
    jacobian: np.ndarray, unknowns: tuple[str, ...], *, noise_px: float, prior: Mapping[str, float]
) -> float:
    """Compute the least standard deviation of an unbiased estimate of the margin, with priors.

    The square root of the margin's entry in (J^T J / sigma^2 + diag(1 / prior^2))^-1, infinite without information.
    """
    assert not set(prior) - set(unknowns)
    rows, scale = observations(jacobian, unknowns, noise_px, prior)
    # the part of the margin's column that no nuisance can imitate
    margin, nuisances = rows[:, 0], (rows / scale)[:, 1:]
    evidence = np.linalg.norm(margin - nuisances @ np.linalg.lstsq(nuisances, margin, rcond=None)[0])
    return float(1 / evidence) if evidence > 0 else float("inf")
