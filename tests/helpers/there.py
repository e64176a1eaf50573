"""Values that may be None elsewhere, and are not in a test."""

from typing import TypeVar

Value = TypeVar("Value")


def there(value: Value | None) -> Value:
    """The value, which is not None."""
    assert value is not None
    return value
