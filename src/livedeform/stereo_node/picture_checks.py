"""Checks on a pair of pictures before anything is measured in them: size, exposure, order of stamps, frozen cameras."""

from __future__ import annotations

from typing import Any

import numpy as np

from livedeform.common.errors import InputError
from livedeform.common.stamps import StampClock, StampKind
from livedeform.common.types import CameraCalibration, Image
from livedeform.stereo_node.camera.rig import StereoRig
from livedeform.stereo_node.detect.picture import Picture, extremes, grey, spread

WHERE = "stereo pictures"
MARKED = 2.0  # times the least contrast of a whole picture: what a few pixels must have to be markers
BLACK, WHITE = 30, 225  # grey values: darker, lighter than all of a picture without contrast


class BadPictures(InputError):
    """A pair of pictures that must not be measured."""


class PictureChecks:
    """Turns pictures to grey ones, and refuses those that must not be measured.

    It remembers the last pair: stamps must grow, save for one that is wrong and where the clock is set (`StampClock`),
    and a picture that is the same to the last pixel comes from a camera that is frozen.
    """

    def __init__(self, rig: StereoRig, min_contrast: float, refuse_frozen: bool) -> None:
        """Take the ``rig`` for the pictures' size; ``min_contrast`` in grey values over the whole picture."""
        self._cameras = {"left": rig.left, "right": rig.right}
        self._min_contrast, self._refuse_frozen = min_contrast, refuse_frozen
        self._last: tuple[Picture, Picture] | None = None
        self._clock = StampClock()

    def grey_pair(self, left: Image, right: Image) -> tuple[Picture, Picture]:
        """Return both pictures in grey, (h, w) each; ``BadPictures`` where they must not be measured."""
        pair = self._grey("left", left), self._grey("right", right)
        self._check_stamp(left.stamp_ns)
        self._check_frozen(pair)
        return pair

    def _grey(self, side: str, image: Image) -> Picture:
        pixels = np.asarray(image.pixels)
        _check_size(side, pixels, self._cameras[side])
        picture = grey(pixels, image.encoding)
        low, high = spread(picture)
        even = high - low < self._min_contrast
        if even:  # as of small balls before a dark wall, which fill no percentile: they have a marker's contrast
            low, high = extremes(picture)
            even = high - low < MARKED * self._min_contrast
        if even:
            what = "black" if high < BLACK else "white" if low > WHITE else "of one grey"
            raise BadPictures(
                f"the {side} picture is {what}",
                where=WHERE,
                remedy="check the light, the lens cap, the exposure, and that 16-bit pictures use all bits",
            )
        return picture

    def _check_stamp(self, stamp_ns: int) -> None:
        if stamp_ns == self._clock.last_ns or self._clock.take(stamp_ns) is StampKind.LATE:
            raise BadPictures(
                "the stamp is not later than the one before",
                where=WHERE,
                remedy="replay pictures in the order of their stamps",
            )

    def _check_frozen(self, pair: tuple[Picture, Picture]) -> None:
        frozen = [] if self._last is None else [_same(a, b) for a, b in zip(pair, self._last, strict=True)]
        self._last = pair
        if self._refuse_frozen and any(frozen):
            which = "both pictures are" if all(frozen) else f"the {'left' if frozen[0] else 'right'} picture is"
            raise BadPictures(
                f"{which} the same as before to the last pixel",
                where=WHERE,
                remedy="the camera is frozen: start its driver again",
            )


def _same(a: Picture, b: Picture) -> bool:
    """Tell whether two pictures are the same to the last pixel; some rows tell most that are not."""
    return np.array_equal(a[::32], b[::32]) and np.array_equal(a, b)


def _check_size(side: str, pixels: np.ndarray[Any, Any], camera: CameraCalibration) -> None:
    if pixels.ndim not in (2, 3) or pixels.size == 0:
        raise BadPictures(f"the {side} picture is empty", where=WHERE, remedy="check that both cameras publish")
    if pixels.shape[:2] != (camera.height, camera.width):
        raise BadPictures(
            f"the {side} picture is {pixels.shape[1]}x{pixels.shape[0]}, its calibration "
            f"{camera.width}x{camera.height}",
            where=WHERE,
            remedy="calibrate at the size that the camera publishes",
        )
