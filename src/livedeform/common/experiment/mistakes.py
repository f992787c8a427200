"""Say the first mistake that pydantic found in what a user wrote, in words."""

from __future__ import annotations

from collections.abc import Sequence

import yaml
from pydantic import ValidationError
from pydantic_core import ErrorDetails

MOST_SHOWN = 60  # characters of a wrong value
IN_WORDS = {  # what pydantic's types of mistakes are called, and what helps
    "model_type": ("should be a mapping", "write keys with their values"),
    "dict_type": ("should be a mapping", "write keys with their values"),
    "tuple_type": ("should be a list", "write it in brackets"),
    "too_short": ("should have an entry", "add one"),
    "too_long": ("has too many entries", "leave out what is too much"),
    "string_type": ("should be a text", "write it in quotation marks"),
}


def first_mistake(error: ValidationError) -> ErrorDetails:
    """Return the first mistake; before what is missing, a key that nobody knows: it may be that one, mistyped."""
    reports = error.errors()
    unknown = (r for r in reports if str(r.get("ctx", {}).get("what", "")).startswith("unknown key"))
    return next(unknown, reports[0])


def in_words(mistake: ErrorDetails, of_missing: str) -> tuple[str, str]:
    """Return what is wrong and the remedy; ``of_missing``: that for a missing key."""
    context = mistake.get("ctx", {})
    if mistake["type"] == "livedeform":
        return context["what"], context["remedy"]
    if mistake["type"] == "missing" and isinstance(mistake["loc"][-1], int):
        return f"has too few entries, {len(mistake['input'])}", "write all of them"
    if mistake["type"] == "missing":
        return f"key '{mistake['loc'][-1]}' is missing", of_missing
    own = mistake["msg"][:1].lower() + mistake["msg"][1:], "correct the value"
    message, remedy = IN_WORDS.get(mistake["type"], own)
    shown = repr(mistake["input"])
    shown = shown if len(shown) < MOST_SHOWN else shown[: MOST_SHOWN - 3] + "..."
    return f"{message}, but it is {shown}", remedy


def locate(node: yaml.Node, loc: Sequence[int | str]) -> tuple[str, int]:
    """Return the dotted key and the line of the deepest part of ``loc`` that is in the file."""
    keys: list[str] = []
    line = node.start_mark.line + 1
    for part in loc:
        child = None
        if isinstance(node, yaml.MappingNode):
            for key, value in node.value:
                if key.value == part:
                    child, line = value, key.start_mark.line + 1
        elif isinstance(node, yaml.SequenceNode) and isinstance(part, int) and part < len(node.value):
            child = node.value[part]
            line = child.start_mark.line + 1
        if child is None:
            break
        keys.append(str(part))
        node = child
    return ".".join(keys), line
