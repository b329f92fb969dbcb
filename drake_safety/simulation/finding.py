"""Finding: the result of a check."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Result of a check.

    Attributes:
        remedy: How to correct a failure, or what a warning is about; "" if all is well.
    """

    item: str
    is_ok: bool
    message: str
    remedy: str = ""

    @property
    def is_warning(self) -> bool:
        """Whether the check passed, but something should be known or done."""
        return self.is_ok and bool(self.remedy)


def passed(item: str, message: str) -> Finding:
    """A finding of a check that passed."""
    return Finding(item=item, is_ok=True, message=message)


def warned(item: str, message: str, remedy: str) -> Finding:
    """A finding of a check that passed with a warning."""
    return Finding(item=item, is_ok=True, message=message, remedy=remedy)


def failed(item: str, message: str, remedy: str) -> Finding:
    """A finding of a check that failed."""
    return Finding(item=item, is_ok=False, message=message, remedy=remedy)
