"""Typed fields of saved JSON: each mistake is told in one sentence with its file and its cure."""

import math
from dataclasses import dataclass
from typing import Any

from sliplens.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Fields:
    """A JSON object that knows which file it came from, and which command makes that file again.

    Attributes
    ----------
    values
        The object's fields.
    where
        Its file, and the place inside it.
    command
        Command that writes the file.
    """

    values: dict[str, Any]
    where: str
    command: str

    def text(self, key: str, *, default: str | None = None) -> str:
        """Return a string."""
        value = self._take(key, default)
        return value if isinstance(value, str) else self._refuse(key, value, "a text")

    def number(self, key: str) -> float:
        """Return a finite number."""
        value = self.optional_number(key)
        return self._refuse(key, None, "a number") if value is None else value

    def optional_number(self, key: str) -> float | None:
        """Return a finite number, or None where the field is null or absent."""
        value = self.values.get(key)
        if value is None:
            return None
        # bool is an int to Python; NaN and infinity are numbers to its JSON reader
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            return self._refuse(key, value, "a finite number")
        return float(value)

    def integer(self, key: str) -> int:
        """Return a whole number."""
        value = self.optional_integer(key)
        return self._refuse(key, None, "a whole number") if value is None else value

    def optional_integer(self, key: str) -> int | None:
        """Return a whole number, or None where the field is null or absent."""
        value = self.optional_number(key)
        if value is not None and not value.is_integer():
            return self._refuse(key, value, "a whole number")
        return None if value is None else int(value)

    def texts(self, key: str) -> tuple[str, ...]:
        """Return a list of strings; empty where the field is absent."""
        value = self.values.get(key, [])
        if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
            return self._refuse(key, value, "a list of texts")
        return tuple(value)

    def integers(self, key: str) -> tuple[int, ...]:
        """Return a list of whole numbers; empty where the field is absent."""
        value = self.values.get(key, [])
        if not isinstance(value, list) or not all(isinstance(item, int) for item in value):
            return self._refuse(key, value, "a list of whole numbers")
        return tuple(value)

    def flag(self, key: str) -> bool:
        """Return true or false."""
        value = self._take(key, None)
        return value if isinstance(value, bool) else self._refuse(key, value, "true or false")

    def optional_numbers(self, key: str) -> tuple[float | None, ...]:
        """Return a list of finite numbers, None where one is null."""
        value = self._take(key, None)
        if not isinstance(value, list):
            return self._refuse(key, value, "a list of numbers")
        inside = self._wrap({f"{key}[{index}]": item for index, item in enumerate(value)}, key)
        return tuple(inside.optional_number(name) for name in inside.values)

    def named_numbers(self, key: str) -> dict[str, float | None]:
        """Return a field that maps names to finite numbers, None where one is null."""
        part = self.part(key)
        return {name: part.optional_number(name) for name in part.values}

    def part(self, key: str) -> "Fields":
        """Return a field that is an object."""
        return self._wrap(self._take(key, None), key)

    def optional_part(self, key: str) -> "Fields | None":
        """Return a field that is an object, or None where it is null or absent."""
        return None if self.values.get(key) is None else self.part(key)

    def inner(self, key: str, *, optional: bool = False) -> dict[str, "Fields"]:
        """Return a field that maps names to objects."""
        value = self._take(key, {} if optional else None)
        if not isinstance(value, dict):
            return self._refuse(key, value, "an object")
        return {name: self._wrap(item, f"{key}.{name}") for name, item in value.items()}

    def rows(self, key: str) -> list["Fields"]:
        """Return a list of objects."""
        value = self._take(key, None)
        if not isinstance(value, list):
            return self._refuse(key, value, "a list")
        return [self._wrap(item, f"{key}[{index}]") for index, item in enumerate(value)]

    def _wrap(self, item: Any, place: str) -> "Fields":
        if not isinstance(item, dict):
            return self._refuse(place, item, "an object")
        return Fields(values=item, where=f"{self.where} at {place}", command=self.command)

    def _take(self, key: str, default: Any) -> Any:
        value = self.values.get(key, default)
        if value is None:
            raise InputError(f"{self.where} lacks {key!r}; make the folder again with `{self.command}`")
        return value

    def _refuse(self, key: str, value: Any, what: str) -> Any:
        if value is None:
            return self._take(key, None)
        shown = repr(value)
        shown = shown if len(shown) <= 40 else f"{shown[:37]}..."
        raise InputError(
            f"{self.where} has {shown} as {key!r} where {what} belongs; make the folder again with `{self.command}`"
        )
