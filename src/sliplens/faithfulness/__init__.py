"""How far an explanation can be believed."""

from sliplens.faithfulness.deletion import (
    DeletionCurves,
    DeletionSummary,
    deletion_curves,
    deletion_order,
    deletion_score,
    random_order,
    summarise_deletion,
)
from sliplens.faithfulness.fills import FILLS, get_fill

__all__ = [
    "FILLS",
    "DeletionCurves",
    "DeletionSummary",
    "deletion_curves",
    "deletion_order",
    "deletion_score",
    "get_fill",
    "random_order",
    "summarise_deletion",
]
