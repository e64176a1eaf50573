"""How far an explanation can be believed."""

from sliplens.faithfulness.fills import FILLS, get_fill
from sliplens.faithfulness.removal import Faithfulness, RemovalCurves, removal_curves
from sliplens.faithfulness.scoring import (
    DeletionCurves,
    deletion_curves,
    deletion_order,
    deletion_score,
    random_order,
    score,
    score_by_deletion,
)

__all__ = [
    "FILLS", "DeletionCurves", "Faithfulness", "RemovalCurves", "deletion_curves", "deletion_order",
    "deletion_score", "get_fill", "random_order", "removal_curves", "score", "score_by_deletion",
]  # fmt: skip
