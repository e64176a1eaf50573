"""Parts of a page that are neither picture nor table of numbers."""

from dataclasses import dataclass
from typing import ClassVar, Literal


@dataclass(frozen=True, kw_only=True)
class Notes:
    """Sentences under a head of their own: what to be wary of, or what was done."""

    layout: ClassVar[str] = "notes"

    title: str
    sentences: tuple[str, ...]
    tone: Literal["plain", "caution"] = "plain"
