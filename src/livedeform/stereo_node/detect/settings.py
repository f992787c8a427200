"""Settings of the detectors: how markers look, and how they are looked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from livedeform.common.errors import InputError

__all__ = ["DetectorSettings"]


@dataclass(frozen=True)
class DetectorSettings:
    """The looks of markers and how they are searched for. Lengths in pixels, grey values in 0..255."""

    type: str = "blob"  # blob | circle_grid | checkerboard | aruco | apriltag
    polarity: str = "both"  # dark | light | both: the markers against what is around them
    min_radius: float = 2.0
    max_radius: float = 20.0
    min_contrast: float = 12.0
    max_aspect: float = 4.0  # long over short axis: a disc seen 75 degrees from its normal has 3.9
    min_rim: float = 0.6  # share of the rim that must be seen
    max_misfit: float = 0.12  # residual of the fit over its contrast, beyond the noise
    min_signal: float = 5.0  # contrast over residual
    max_sigma: float = 0.5  # px, of the centre
    marker: str = "painted"  # painted: a disc that follows the body's curvature | flat: a stiff one | ball
    centre: str = "fit"  # fit: blurred ellipses | moments: the centroid, for markers of another outline
    levels: int = 3  # thresholds at which spots are looked for: on a textured ground a low one joins marker and texture
    surroundings: tuple[float, ...] = (3.0, 1.0)  # half widths, in max_radius, of what a spot must stand out from: the
    # wide one bears uneven shapes of ground, the narrow one finds a marker on a small bright plate before a black wall
    most: int = 0  # candidates that are measured, the most prominent first; 0: all
    search_step: int = 1  # 2: spots are looked for in the picture at half size (and measured at full size)
    dictionary: str = ""  # of aruco and apriltag
    board: str = ""  # of circle_grid and checkerboard, as 9x6

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> DetectorSettings:
        """Read ``stereo.detector`` of an experiment; unknown keys and impossible values are an ``InputError``."""
        known = {field.name: field.default for field in fields(cls)}
        read: dict[str, Any] = {}
        for key, value in values.items():
            if key not in known:
                raise InputError(
                    f"unknown key '{key}'", where="stereo.detector", remedy=f"use one of {', '.join(sorted(known))}"
                )
            read[key] = _checked(key, value, known[key])
        settings = cls(**read)
        if settings.min_radius >= settings.max_radius:
            raise InputError(
                f"min_radius {settings.min_radius:g} is not below max_radius {settings.max_radius:g}",
                where="stereo.detector",
                remedy="give the smallest and the largest radius of a marker's picture, px",
            )
        return settings


CHOICES = {
    "type": ("blob", "circle_grid", "checkerboard", "aruco", "apriltag"),
    "polarity": ("dark", "light", "both"),
    "marker": ("painted", "flat", "ball"),
    "centre": ("fit", "moments"),
}


def _checked(key: str, value: Any, default: Any) -> Any:
    """Return a setting of the type of its default, or ``InputError``."""
    where = f"stereo.detector.{key}"
    if key in CHOICES and value not in CHOICES[key]:
        raise InputError(f"'{value}' is unknown", where=where, remedy=f"use one of {', '.join(CHOICES[key])}")
    if isinstance(default, str):
        return str(value)
    wanted = value if isinstance(default, tuple) else [value]
    whole = isinstance(default, int)
    if not isinstance(wanted, list | tuple) or not wanted or not all(_is_number(v, whole) for v in wanted):
        kind = "a list of numbers" if isinstance(default, tuple) else "a whole number" if whole else "a number"
        raise InputError(f"{value!r} is not {kind} of 0 or more", where=where, remedy=f"the default is {default}")
    return tuple(float(v) for v in wanted) if isinstance(default, tuple) else int(value) if whole else float(value)


def _is_number(value: Any, whole: bool) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return bool(np.isfinite(value) and value >= 0 and not (whole and value != int(value)))
