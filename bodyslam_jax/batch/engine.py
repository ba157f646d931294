"""Defines engines, which evaluate a function on many items in other processes.

The function, the items and their values must be picklable. An engine is independent of
clips.
"""

import dataclasses
from collections.abc import Callable, Generator, Sequence
from typing import Any, Protocol, runtime_checkable

Setup = Callable[[], None]
"""Prepares a new process, once, before its first item."""
Values = Generator[tuple[Any, Any], None, None]
"""Items with their values."""


@dataclasses.dataclass(frozen=True)
class Failure:
    """Takes the place of a value if the function raised, or its process was lost more
    often than the engine retries."""

    message: str


@runtime_checkable
class Engine(Protocol):
    """Evaluates a function on items in other processes."""

    def map(
        self, function: Callable[[Any], Any], items: Sequence[Any], setup: Setup
    ) -> Values:
        """Yields each item with its value, or a `Failure`, as they finish.

        Closing the generator ends what is running.

        **Raises:** `ValueError` if `setup` fails or the engine is not available.
        """
        ...


def attempt(function: Callable[[Any], Any], item: Any) -> Any:
    """Returns the function's value, or a `Failure` with the error that it raised."""
    try:
        return function(item)
    except Exception as error:
        return Failure(f"{type(error).__name__}: {' '.join(str(error).split())}")
