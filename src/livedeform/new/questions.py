"""Ask what no file tells: each has an option, and a default only where one is safe."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from livedeform.common.errors import InputError
from livedeform.common.experiment.schema import DEFAULT_GRAVITY, MATERIALS, Thresholds
from livedeform.new.body import NewBody

Ask = Callable[[str, str | None], str]  # (question, default) -> the answer as it was typed

PROBES = {"ball": ("sphere", 1), "cylinder": ("cylinder", 2), "box": ("box", 3)}
METRE = 1.0  # m; no probe is as large as that, in millimetres many are
PROBE_REMEDY = "write ball:R, cylinder:R,H or box:L,W,H in metres (ball:0.01), mesh:FILE, or none"


@dataclass(frozen=True)
class Question:
    """One thing to know: ``name`` of the option without dashes, the question, the default as it would be typed (None:
    it must be answered), and what reads the answer (raises ``ValueError`` or ``InputError``)."""

    name: str
    text: str
    default: str | None
    read: Callable[[str], Any]

    @property
    def option(self) -> str:
        return "--" + self.name.replace("_", "-")


@dataclass(frozen=True)
class Answers:
    """Everything that was said: ``values`` by the question's name, and what was ``assumed`` without being asked."""

    values: Mapping[str, Any]
    assumed: tuple[str, ...]

    def __getitem__(self, name: str) -> Any:
        return self.values[name]


def questions(body: NewBody, folder: Path) -> list[Question]:
    """All questions about a body, with the defaults that its surface suggests."""
    base = f"{body.base:.3g}" if body.base is not None else None
    earth = ",".join(f"{x:g}" for x in DEFAULT_GRAVITY)
    return [
        Question("name", "What is the experiment called?", folder.resolve().name, str),
        Question(
            "configuration",
            "Was the surface scanned while its own weight acted on it (loaded), or is it the shape without weight "
            "(unloaded)?",
            None,
            _one_of("loaded", "unloaded"),
        ),
        Question("gravity", "Gravity during the recording, m/s2 in the surface's frame?", earth, _vector),
        Question("density", "Density, kg/m3?", "1000", _positive),
        Question("density_sigma", "Its standard deviation, kg/m3 (or unknown)?", "unknown", _positive_or_none),
        Question("material", f"Material law ({', '.join(MATERIALS)})?", "neo_hookean", _one_of(*MATERIALS)),
        Question("modulus", "Young's modulus, Pa (a guess will do: a diagnosis can find it)?", None, _positive),
        Question("modulus_sigma", "Its standard deviation, Pa (or unknown)?", "unknown", _positive_or_none),
        Question("poisson", "Poisson's ratio (nearly incompressible: 0.49)?", "0.49", float),
        Question("support", "How is it held at its base (fixed, sliding)?", "fixed", _one_of("fixed", "sliding")),
        Question("support_below", "Up to which height z is it held, m?", base, float),
        Question("probe", "What presses on it? " + PROBE_REMEDY[:1].upper() + PROBE_REMEDY[1:], None, read_probe),
        Question("edge_radius", "Radius that rounds the probe's edges, m?", "0", _not_negative),
        Question("friction", "Coefficient of friction between probe and body?", "0", _not_negative),
        Question(
            "cameras",
            "Which cameras: LEFT.yaml,RIGHT.yaml (ROS calibration files), recorded (CameraInfo in the recording), or "
            "none (another tracker gives points)?",
            "none",
            _cameras,
        ),
        Question("element_size", "Edge length of the tetrahedra, m?", f"{body.element_size:g}", _positive),
        Question("threshold", "Up to which error is a run good, m?", f"{Thresholds().error:g}", _positive),
    ]


def answered(asked: list[Question], given: Mapping[str, str | None], ask: Ask | None) -> Answers:
    """The answers: as given by options, else asked, else assumed; one ``InputError`` names every option that lacks."""
    values: dict[str, Any] = {}
    assumed, missing = [], []
    for question in asked:
        text = given.get(question.name)
        if question.name in _pointless(values):
            values[question.name] = _read(question, str(question.default))
        elif text is None and ask is not None:
            values[question.name] = _asked(question, ask)
        elif text is None and question.default is None:
            missing.append(question)
        else:
            values[question.name] = _read(question, text if text is not None else str(question.default))
            if text is None:
                assumed.append(f"{question.name.replace('_', ' ')} {question.default}")
    if missing:
        lacking = ", ".join(question.option for question in missing)
        raise InputError(f"not given: {lacking}", remedy="give these options, or run it on a terminal to be asked")
    return Answers(values, tuple(assumed))


def _pointless(values: Mapping[str, Any]) -> tuple[str, ...]:
    """The questions that the answers so far make pointless: edges of a ball, friction of no probe."""
    if "probe" not in values:
        return ()
    if values["probe"] is None:
        return ("edge_radius", "friction")
    return ("edge_radius",) if {"sphere", "mesh"} & set(values["probe"]) else ()


def _asked(question: Question, ask: Ask) -> Any:
    """Ask until the answer can be read."""
    text = question.text
    while True:
        try:
            return _read(question, ask(text, question.default))
        except InputError as error:
            text = f"{error.what}; {error.remedy}\n{question.text}"


def _read(question: Question, text: str) -> Any:
    try:
        return question.read(text.strip())
    except InputError as error:
        raise InputError(error.what, where=question.option, remedy=error.remedy) from error
    except ValueError as error:
        raise InputError(f"'{text}' is no answer", where=question.option, remedy=question.text) from error


def read_probe(text: str) -> dict[str, Any] | None:
    """``ball:0.01`` as {"sphere": 0.01}; None for ``none``."""
    kind, _, sizes = text.partition(":")
    if kind == "none":
        return None
    if kind == "mesh" and sizes:
        if not Path(sizes).is_file():
            raise InputError(f"the file {sizes} does not exist", remedy="name a closed surface in metres")
        return {"mesh": sizes}
    if kind not in PROBES:
        raise InputError(f"'{text}' is no probe", remedy=PROBE_REMEDY)
    key, n = PROBES[kind]
    numbers = [_positive(size) for size in sizes.split(",")]
    if len(numbers) != n:
        raise InputError(f"a {kind} has {n} sizes, not {len(numbers)}", remedy=PROBE_REMEDY)
    if max(numbers) >= METRE:
        meant = ",".join(f"{1e-3 * number:g}" for number in numbers)
        raise InputError(f"{key} is {max(numbers):g} m", remedy=f"write {kind}:{meant} if millimetres are meant")
    return {key: numbers[0] if n == 1 else numbers}


def _cameras(text: str) -> tuple[str, ...] | None:
    """No cameras: None; those of the recording: ()."""
    if text == "none":
        return None
    if text == "recorded":
        return ()
    files = tuple(part.strip() for part in text.split(","))
    lost = [file for file in files if not Path(file).is_file()]
    if len(files) != 2 or lost:
        what = f"the file {lost[0]} does not exist" if lost else f"'{text}' are not two files"
        raise InputError(what, remedy="write LEFT.yaml,RIGHT.yaml, recorded, or none")
    return files


def _one_of(*words: str) -> Callable[[str], str]:
    def read(text: str) -> str:
        if text not in words:
            raise InputError(f"'{text}' is not known", remedy=f"known are {', '.join(words)}")
        return text

    return read


def _positive(text: str) -> float:
    value = float(text)
    if not 0 < value < float("inf"):
        raise InputError(f"{text} is not positive", remedy="give a positive number in SI units")
    return value


def _positive_or_none(text: str) -> float | None:
    return None if text == "unknown" else _positive(text)


def _not_negative(text: str) -> float:
    return 0.0 if float(text) == 0 else _positive(text)


def _vector(text: str) -> tuple[float, ...]:
    numbers = tuple(float(part) for part in text.split(","))
    if len(numbers) != 3:
        raise InputError(f"'{text}' are not three numbers", remedy="write 0,0,-9.81")
    return numbers
