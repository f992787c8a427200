"""Is the new experiment sound, by all that ``livedeform info`` looks at? What is not is said of the user's option."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from livedeform.common.errors import InputError
from livedeform.common.experiment.yaml_file import FILE_NAME
from livedeform.inspection import inspect_experiment

# the option that said what is wrong, by a word of the place or of the sentence; the first that is found
OPTIONS = {
    "phantom.configuration": "--configuration", "element_size": "--element-size", "phantom.density": "--density",
    "youngs_modulus": "--modulus", "poisson_ratio": "--poisson", "gravity": "--gravity", "support": "--support-below",
    "friction": "--friction", "edge_radius": "--edge-radius", "probe": "--probe", "thresholds": "--threshold",
}  # fmt: skip
WORDS = {"WARN": "warning", "NOTE": "note"}


def inspected(draft: Path, given: Mapping[str, Path]) -> list[str]:
    """Return what is worth knowing of the experiment in ``draft``, a line each.

    ``given`` are the user's files by their names in the draft. Raises ``InputError`` where it cannot be used as it is.
    """
    try:
        findings = inspect_experiment(draft).findings
    except InputError as error:
        where, option = error.where, ""
        if where.startswith(str(draft / FILE_NAME)):
            said = f"{where.removeprefix(str(draft / FILE_NAME))} {error.what}"
            option = next((option for word, option in OPTIONS.items() if word in said), "")
        raise InputError(error.what, where=option or _of_user(where, draft, given), remedy=error.remedy) from error
    lines = []
    for finding in findings:
        text = _of_user(finding.text, draft, given)
        if finding.level == "ERROR":
            raise InputError(text, remedy=finding.remedy)
        lines.append(f"{WORDS[finding.level]}: {text}" + (f"; {finding.remedy}" if finding.remedy else ""))
    return lines


def _of_user(text: str, draft: Path, given: Mapping[str, Path]) -> str:
    """Return a text with the user's files in place of their copies, which are gone."""
    for name, file in given.items():
        text = text.replace(str(draft / name), str(file))
    return text.replace(f"{draft}/", "")
