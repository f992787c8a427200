"""Say the first mistake that pydantic found in what a user wrote, in words."""

from __future__ import annotations

from collections.abc import Mapping

from pydantic import ValidationError
from pydantic_core import ErrorDetails

MOST_SHOWN = 60  # characters of a wrong value


def first_mistake(error: ValidationError) -> ErrorDetails:
    """Return the first mistake; before what is missing, a key that nobody knows: it may be that one, mistyped."""
    reports = error.errors()
    unknown = (r for r in reports if str(r.get("ctx", {}).get("what", "")).startswith("unknown key"))
    return next(unknown, reports[0])


def in_words(
    mistake: ErrorDetails, of_missing: str, others: Mapping[str, tuple[str, str]] | None = None
) -> tuple[str, str]:
    """Return what is wrong and the remedy; ``of_missing``: that for a missing key. ``others`` says what pydantic's own
    types of mistakes are called and what helps."""
    context = mistake.get("ctx", {})
    if mistake["type"] == "livedeform":
        return context["what"], context["remedy"]
    if mistake["type"] == "missing":
        return f"key '{mistake['loc'][-1]}' is missing", of_missing
    own = mistake["msg"][:1].lower() + mistake["msg"][1:], "correct the value"
    message, remedy = (others or {}).get(mistake["type"], own)
    shown = repr(mistake["input"])
    shown = shown if len(shown) < MOST_SHOWN else shown[: MOST_SHOWN - 3] + "..."
    return f"{message}, but it is {shown}", remedy
