"""Reference pages from the code: commands, keys of ``experiment.yaml``, topics, the stable Python names."""

from __future__ import annotations

import importlib
import inspect
import re
from pathlib import Path
from typing import Any

import typer

from livedeform.cli import app
from livedeform.common.experiment.yaml_file import json_schema
from livedeform.common.topics import TOPICS

ROOT = Path(__file__).resolve().parents[1]
MADE = "<!-- made by docs/make_reference.py -->\n\n"


def pages() -> dict[str, str]:
    """Markdown by the page's name."""
    made = {"cli": command_line(), "keys": keys(), "topics": topics(), "python": python()}
    return {name: MADE + text for name, text in made.items()}


def command_line() -> str:
    """Every command with its options, as ``--help`` has them."""
    parts = [
        "# The command line\n",
        "Exit codes: 0 done; 1 the verdict is negative where a command judges; 2 wrong input or usage; 130 stopped by "
        "Ctrl-C. An error is one line; `--debug` adds the traceback.\n",
    ]
    parts += _commands(typer.main.get_command(app), ("livedeform",), 2)
    return "\n".join(parts)


def _commands(command: Any, words: tuple[str, ...], level: int) -> list[str]:
    parts: list[str] = []
    for name, sub in sorted(getattr(command, "commands", {}).items()):
        path = (*words, name)
        arguments = " ".join(p.metavar or p.name.upper() for p in sub.params if p.param_type_name == "argument")
        parts += [f"{'#' * level} {' '.join(path)}\n", _prose(sub.help or ""), ""]
        if not getattr(sub, "commands", None):
            parts += [f"    {' '.join(path)} {arguments} [OPTIONS]\n", *_options(sub), ""]
        parts += _commands(sub, path, level + 1)
    return parts


def _prose(text: str) -> str:
    """Help as paragraphs; example commands as code."""
    lines = [line.strip() for line in inspect.cleandoc(text).splitlines()]
    return "\n".join(f"    {line}" if line.startswith("livedeform ") else line for line in lines)


def _options(command: Any) -> list[str]:
    rows = ["| | |", "|---|---|"]
    for p in command.params:
        if p.name == "help":
            continue
        is_option = p.param_type_name == "option"
        name = ", ".join(f"`{o}`" for o in p.opts) if is_option else f"`{p.metavar or p.name.upper()}`"
        silent = p.default in (None, False, ()) or p.required or callable(p.default)
        default = "" if silent else f" Default: {p.default}."
        rows.append(f"| {name} | {_cell(getattr(p, 'help', '') or '')}{default} |")
    return rows


def _cell(text: str) -> str:
    return " ".join(str(text).split()).replace("|", "\\|").replace("<", "&lt;")


def keys() -> str:
    """Every key of the schema: its type, its default, what it means."""
    schema = json_schema()
    parts = [
        "# Every key of experiment.yaml\n",
        "Made from the schema that checks the file; editors read it as `experiment.schema.json`, which "
        "`livedeform new` writes beside the file and `livedeform schema` prints. Any quantity may have one standard "
        "deviation beside it, as `density_sigma`. [The experiment folder](../experiment.md) shows a whole file.\n",
    ]
    parts += _section("experiment", schema, schema)
    for name in sorted(schema["$defs"]):
        if schema["$defs"][name].get("properties"):
            parts += _section(name, schema["$defs"][name], schema)
    return "\n".join(parts)


def _section(name: str, section: dict[str, Any], schema: dict[str, Any]) -> list[str]:
    rows = [f"## {name}\n", "| key | type | default | |", "|---|---|---|---|"]
    for key, entry in section["properties"].items():
        if key.endswith("_sigma"):
            continue
        default = "must be given" if key in section.get("required", ()) else _default(entry)
        rows.append(f"| `{key}` | {_type(entry)} | {default} | {_cell(entry.get('description', ''))} |")
    return [*rows, ""]


def _default(entry: dict[str, Any]) -> str:
    value = entry.get("default")
    return "" if value in (None, [], {}) or isinstance(value, dict) else f"`{value}`"


def _type(entry: dict[str, Any]) -> str:
    """A JSON type in words, with a link to the section that it is."""
    if "$ref" in entry:
        name = entry["$ref"].rsplit("/", 1)[1]
        return f"[{name}](#{name.lower()})"
    if "enum" in entry:
        return " \\| ".join(map(str, entry["enum"]))
    if "const" in entry:
        return str(entry["const"])
    for word in ("anyOf", "oneOf", "allOf"):
        if word in entry:
            return " or ".join(dict.fromkeys(_type(e) for e in entry[word] if e.get("type") != "null"))
    if entry.get("type") == "array":
        items = entry.get("prefixItems")
        return f"{len(items)} × {_type(items[0])}" if items else f"list of {_type(entry.get('items', {}))}"
    return str(entry.get("type", "any"))


def topics() -> str:
    """The table of topics."""
    rows = ["| topic | type | published by | latched |", "|---|---|---|---|"]
    for topic in TOPICS.values():
        by = topic.publisher or "camera, tracker or robot"
        rows.append(
            f"| `{topic.name}` | {topic.type.replace('/msg/', '/')} | {by} | {'yes' if topic.latched else ''} |"
        )
    text = (
        "# Topics\n\nAll in SI; the frame is `phantom` except for cameras; time is `header.stamp`. What a recording "
        "must hold is on the page [Recordings](../recordings.md), what the nodes do on [the graph](../graph.md). A "
        "latched topic keeps its last messages for late subscribers (transient local).\n\n"
    )
    return text + "\n".join(rows) + "\n"


def python() -> str:
    """The stable names with their signatures and docstrings."""
    page = (ROOT / "docs" / "api.md").read_text()
    parts = ["# Python\n", "The names that stay ([what is stable](../api.md)), with their docstrings.\n"]
    for dotted in dict.fromkeys(re.findall(r"`(livedeform(?:\.\w+)+\.\w+)`", page)):
        module, name = dotted.rsplit(".", 1)
        value = getattr(importlib.import_module(module), name)
        parts += [f"## {name}\n", f"    from {module} import {name}\n", _documented(name, value), ""]
        if inspect.isclass(value):
            for method, function in inspect.getmembers(value, inspect.isfunction):
                if not method.startswith("_") and function.__doc__ and function.__module__.startswith("livedeform"):
                    parts += [f"### {name}.{method}\n", _documented(method, function), ""]
    return "\n".join(parts)


def _documented(name: str, value: Any) -> str:
    """Signature and docstring as preformatted text: arrays' shapes and formulas keep their form."""
    try:
        signature = f"{name}{inspect.signature(value)}".replace("livedeform.", "")
    except (TypeError, ValueError):
        signature = name
    return f"```text\n{signature}\n\n{inspect.getdoc(value) or ''}\n```"


if __name__ == "__main__":
    for page_name, text in pages().items():
        print(page_name, len(text.split()), "words")
