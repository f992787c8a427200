"""YAML as it is read from files that may be damaged or hostile: bounded in size, depth and time, one line if wrong."""

from __future__ import annotations

from typing import Any

import yaml

from livedeform.common.errors import InputError

MAX_CHARACTERS = 4_000_000
MAX_NODES = 500_000  # with every alias written out
MAX_DEPTH = 50
MAX_DIGITS = 1000  # of a whole number: Python prints no more than 4300, and of base 60 a character is two
INTEGER = "tag:yaml.org,2002:int"
LONG = 100_000  # characters from which on the faster parser is used, whose messages are worse


def parse_yaml(text: str, where: str) -> tuple[yaml.Node | None, Any]:
    """Return the tree, with its line numbers, and the value of one document; None and None where it is empty.

    Aliases are allowed where what they stand for stays small. ``InputError`` names the line of what is wrong.
    """
    if len(text) > MAX_CHARACTERS:
        what = f"has {len(text)} characters, over {MAX_CHARACTERS}"
        raise InputError(what, where=where, remedy="keep tables in files of their own")
    kind: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader) if len(text) > LONG else yaml.SafeLoader
    try:
        loader = kind(text)
        try:
            node: yaml.Node | None = loader.get_single_node()
            if node is None:
                return None, None
            _refuse_large(node, where)
            return node, loader.construct_document(node)
        finally:
            loader.dispose()
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        what = f"not valid YAML, {error.problem or error}"
        tab = "'\\t'" in what
        remedy = "write spaces instead of tabs" if tab else "look at brackets, colons and indentation"
        raise InputError(what, where=f"{where}:{line}", remedy=remedy) from error
    except yaml.YAMLError as error:
        what = f"not valid YAML, {' '.join(str(error).split())}"
        raise InputError(what, where=where, remedy="save it as plain UTF-8 text") from error
    except RecursionError as error:
        raise _too_deep(where) from error
    except (ValueError, OverflowError, TypeError) as error:  # numbers with thousands of digits, days that there are not
        what = f"not valid YAML, a value that cannot be read ({' '.join(str(error).split())[:80]})"
        raise InputError(what, where=where, remedy="correct the value") from error


def parse_settings(text: str, where: str) -> tuple[yaml.Node | None, Any]:
    """Return the same of a file that a user writes. ``InputError`` also for what YAML reads otherwise than it is meant:
    a key that is there twice, of which the last counts, and a number with leading zeros."""
    node, document = parse_yaml(text, where)
    _refuse_doubled_keys(node, where)
    _refuse_octal(node, where)
    return node, document


def _refuse_doubled_keys(node: yaml.Node | None, where: str) -> None:
    """Raise ``InputError`` for a key that stands twice in a mapping, and for one that is no plain word."""
    if isinstance(node, yaml.SequenceNode):
        for item in node.value:
            _refuse_doubled_keys(item, where)
    if isinstance(node, yaml.MappingNode):
        seen: set[str] = set()
        for key, value in node.value:
            line = f"{where}:{key.start_mark.line + 1}"
            if not isinstance(key, yaml.ScalarNode):
                raise InputError("a key is no plain word", where=line, remedy="write 'key: value'")
            if key.value in seen:
                raise InputError(f"key '{key.value}' is there twice", where=line, remedy="delete one of them")
            seen.add(key.value)
            _refuse_doubled_keys(value, where)


def _refuse_large(root: yaml.Node, where: str) -> None:
    """Raise ``InputError`` for aliases that lead back to themselves, or that stand for more than can be meant."""
    sizes: dict[int, int] = {}  # by id of the node

    def size(node: yaml.Node, depth: int) -> int:
        if id(node) in sizes:
            if sizes[id(node)] == 0:  # we are in it
                line = node.start_mark.line + 1
                raise InputError("an alias leads back to itself", where=f"{where}:{line}", remedy="write it out")
            return sizes[id(node)]
        if depth > MAX_DEPTH:
            raise _too_deep(where)
        sizes[id(node)] = 0
        inner: list[yaml.Node] = []
        if isinstance(node, yaml.MappingNode):
            inner = [part for pair in node.value for part in pair]
        elif isinstance(node, yaml.SequenceNode):
            inner = node.value
        elif node.tag == INTEGER and len(node.value) > MAX_DIGITS:
            where_exactly = f"{where}:{node.start_mark.line + 1}"
            raise InputError(f"a number with {len(node.value)} digits", where=where_exactly, remedy="correct the value")
        total = 1 + sum(size(part, depth + 1) for part in inner)
        if total > MAX_NODES:
            what = f"its aliases stand for more than {MAX_NODES} values"
            raise InputError(what, where=where, remedy="write out what is meant")
        sizes[id(node)] = total
        return total

    size(root, 0)


def _refuse_octal(node: yaml.Node | None, where: str) -> None:
    """Raise ``InputError`` for a number with leading zeros, which YAML reads to the base 8: 04000 is 2048."""
    if isinstance(node, yaml.ScalarNode):
        digits = node.value.replace("_", "").lstrip("+-")
        if node.tag == INTEGER and digits.isdigit() and digits[0] == "0" and int(digits, 8) != int(digits):
            what = f"{node.value} begins with a zero, and is read as {int(digits, 8)}, to the base 8"
            remedy = "leave the zero out, or put quotes around a name"
            raise InputError(what, where=f"{where}:{node.start_mark.line + 1}", remedy=remedy)
    elif node is not None:
        for item in node.value:
            for part in item if isinstance(item, tuple) else (item,):
                _refuse_octal(part, where)


def _too_deep(where: str) -> InputError:
    return InputError(f"is nested more than {MAX_DEPTH} deep", where=where, remedy="look at brackets and indentation")
