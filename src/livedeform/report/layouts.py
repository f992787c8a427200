"""The shipped layouts of Foxglove and RViz, fitted to what a run holds: no panel without data."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from typing import Any

import yaml

from livedeform.shipped import shipped_file

RAW, COMPRESSED = "/image_raw", "/image_raw/compressed"


def foxglove_layout(topics: Collection[str]) -> dict[str, Any]:
    """The layout for a recording with ``topics``: pictures as they are recorded, only lines and layers with data."""
    layout: dict[str, Any] = json.loads(shipped_file("config/foxglove.json").read_text())
    for panel in layout["configById"].values():
        if "topics" in panel:
            panel["topics"] = {name: look for name, look in panel["topics"].items() if name in topics}
        if "paths" in panel:
            panel["paths"] = [path for path in panel["paths"] if topic_of(path["value"]) in topics]
        if "imageMode" in panel:
            panel["imageMode"] = _picture(panel["imageMode"], topics)
    kept = {name for name, panel in layout["configById"].items() if topics_of_panel(panel)}
    layout["configById"] = {name: panel for name, panel in layout["configById"].items() if name in kept}
    layout["layout"] = _pruned(layout["layout"], kept)
    return layout


def _picture(mode: Mapping[str, Any], topics: Collection[str]) -> dict[str, Any]:
    """A picture's topics as they are recorded."""
    known = [name for name in (mode["imageTopic"], mode["imageTopic"].removesuffix("/compressed")) if name in topics]
    notes = {name: look for name, look in mode["annotations"].items() if name in topics}
    calibration = {"calibrationTopic": mode["calibrationTopic"]} if mode["calibrationTopic"] in topics else {}
    return {"imageTopic": known[0], "annotations": notes, **calibration} if known else {}


def topic_of(value: str) -> str:
    """The topic of a path into a message, as ``/compare/rmse.data``."""
    return value.split(".")[0]


def topics_of_panel(panel: Mapping[str, Any]) -> set[str]:
    """Every topic that a Foxglove panel names."""
    mode = panel.get("imageMode", {})
    named = {*panel.get("topics", {}), *(topic_of(path["value"]) for path in panel.get("paths", ()))}
    named |= {mode[key] for key in ("imageTopic", "calibrationTopic") if key in mode} | set(mode.get("annotations", {}))
    return named | ({panel["topicToRender"]} if "topicToRender" in panel else set())


def _pruned(node: Any, kept: Collection[str]) -> Any:
    """A tree of panels without those that are not kept; None of none."""
    if isinstance(node, str):
        return node if node in kept else None
    first, second = _pruned(node["first"], kept), _pruned(node["second"], kept)
    if first is None or second is None:
        return second if first is None else first
    return {**node, "first": first, "second": second}


def rviz_layout(topics: Collection[str]) -> dict[str, Any]:
    """The RViz configuration without displays of topics that are not there."""
    document: dict[str, Any] = yaml.safe_load(shipped_file("config/scene.rviz").read_text())
    manager = document["Visualization Manager"]
    manager["Displays"] = [d for d in manager["Displays"] if "Topic" not in d or _shown(d["Topic"], topics)]
    return document


def _shown(topic: dict[str, Any], topics: Collection[str]) -> bool:
    """Tell whether the display has data; RViz names a compressed picture by its raw topic, beside its transport."""
    return topic["Value"] in topics or (topic["Value"].endswith(RAW) and topic["Value"] + "/compressed" in topics)
