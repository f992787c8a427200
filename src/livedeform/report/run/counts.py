"""The counts of `metrics.json`, with what each means."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def describe_counts(counts: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Rows for the page of ``metrics.json``'s counts."""
    rows = []
    for key, value in counts.items():
        if isinstance(value, Mapping) and not value:
            rows.append((_words(key), "0", MEANING.get(key, "")))
        elif isinstance(value, Mapping) and value.keys() >= {"sent", "received", "lost"}:
            sums = f"{value['sent']} = {value['received']} + {value['lost']}"
            before = f"; {value['before']} were published before the first that came" if "before" in value else ""
            rows.append((_words(key), sums, f"sent = received + lost{before}"))
        elif isinstance(value, Mapping):
            rows += [(f"{key}: {name}", text, why) for name, text, why in describe_counts(value)]
        elif isinstance(value, list):
            rows.append((_words(key), str(len(value)), ", ".join(map(str, value[:20])) or MEANING.get(key, "")))
        elif isinstance(value, int | float | str):
            rows.append((_words(key), f"{value:g}" if isinstance(value, float) else str(value), MEANING.get(key, "")))
    return rows


MEANING = {
    "measured_frames": "frames with measured markers",
    "predicted_frames": "frames of the model",
    "predicted_not_converged": "frames for which the model found no equilibrium; they match nothing",
    "matched_frames": "measured frames that were compared",
    "refused_extrapolation": "measured before the first or after the last prediction",
    "refused_gap": "between predictions too far apart to interpolate",
    "refused_not_converged": "beside a prediction that did not converge",
    "refused_out_of_order": "measured and predicted frames whose stamps ran backwards or jumped",
    "predicted_out_of_order": "predicted ones among them",
    "dropped_waiting": "waited too long for a prediction",
    "matched_markers": "single errors",
    "lost_messages": "sent, but not received",
    "measured_without_prediction": "measured markers that the model did not predict",
    "measured_twice": "measured markers of a frame that share their id; none of them is compared",
    "predicted_without_measurement": "predicted markers that were not seen (occluded, or not found)",
    "frames_without_common_marker": "measured frames none of whose markers the model knows",
    "predicted": "frames that the model was asked for",
    "not_converged": "no equilibrium was found; published as such",
    "skipped": "poses overtaken by a newer one, on their way or while the model was solving",
    "unfinished": "poses that the model was still solving when the run ended",
    "pairs": "pairs of pictures",
    "unpaired": "pictures without a partner of the other camera",
    "unknown_ids": "ids that the experiment does not know",
    "never_measured_ids": "markers of the experiment that were never seen",
}


def _words(key: str) -> str:
    return key.replace("_", " ")
