"""Model-based estimators of the safety margin: what the networks are compared with."""

from sliplens.markers.estimators.estimators import ESTIMATORS, MarginEstimator, get_estimator
from sliplens.markers.estimators.trial import FieldTrial, affine_parts, field_trial, find_hold

__all__ = [
    "ESTIMATORS",
    "FieldTrial",
    "MarginEstimator",
    "affine_parts",
    "field_trial",
    "find_hold",
    "get_estimator",
]
