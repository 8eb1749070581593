"""What a reader leaves out of a file, and what it changes: one account of both."""

from collections import Counter
from collections.abc import Mapping
from typing import Any, SupportsInt

from jaxslam.core.validation import InvalidFile


class Account:
    """Counts of what is left out, by reason, and descriptions of what is changed.

    dropped: the counts so far; a reason with 0 is listed.
    """

    def __init__(self, dropped: Mapping[str, int] | None = None) -> None:
        self.dropped: Counter[str] = Counter(dropped)
        self.corrections: list[str] = []

    def drop(self, reason: str, count: SupportsInt = 1) -> None:
        """Add to a count; 0 of a reason does not list it."""
        if count:
            self.dropped[reason] += int(count)

    def correct(self, text: str, count: object = 1) -> None:
        """Describe a change, unless the count of what it concerns is 0."""
        if count:
            self.corrections.append(text)

    def none_left(self, path: Any, line: int | None = None) -> InvalidFile:
        """The error about a file whose measurements are all left out, with the reasons."""
        reasons = ", ".join(f"{n:,} {reason}" for reason, n in self.dropped.items() if n)
        reason = f"no measurement is left, of {reasons or 'none in the file'}"
        return InvalidFile(path, reason, line)

    @property
    def fields(self) -> dict[str, Any]:
        """The fields `dropped` and `corrections` of what is read."""
        return {"dropped": dict(self.dropped), "corrections": tuple(self.corrections)}
