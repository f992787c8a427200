"""Pictures and camera calibrations from and to messages; rclpy's and rosbags' message objects have the same fields."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from livedeform.common.bags.types import one_line
from livedeform.common.errors import RecordingError
from livedeform.common.types import CameraCalibration, Image


def read_camera_info(message: Any, name: str = "") -> CameraCalibration:
    """Return the calibration in a sensor_msgs/CameraInfo; its ``name`` is the frame's unless one is given.

    ``RecordingError`` where a matrix has not the size that it must have.
    """
    sizes = {"k": 9, "r": 9, "p": 12}
    wrong = [key for key, n in sizes.items() if len(getattr(message, key)) != n]
    if wrong:
        raise RecordingError(f"a camera_info's {wrong[0]} has not {sizes[wrong[0]]} numbers", remedy="calibrate again")
    return CameraCalibration(
        name=name or message.header.frame_id,
        width=int(message.width),
        height=int(message.height),
        camera_matrix=np.array(message.k, float).reshape(3, 3),
        dist_coeffs=np.array(message.d, float),
        rectification=np.array(message.r, float).reshape(3, 3),
        projection=np.array(message.p, float).reshape(3, 4),
        distortion_model=message.distortion_model,
    )


MAX_PIXELS = 64_000_000
WIDE = ("mono16", "16UC1")
CHANNELS = {"mono8": 1, "8UC1": 1, "bgr8": 3, "rgb8": 3, "8UC3": 3, "bgra8": 4, "rgba8": 4, "8UC4": 4}
NAMES = {"8UC1": "mono8", "8UC3": "bgr8", "bgra8": "bgr8", "rgba8": "rgb8", "8UC4": "bgr8"}


def read_image(message: Any, stamp_ns: int) -> Image:
    """Return the picture of a sensor_msgs/Image (no copy where rows are not padded)."""
    wide = message.encoding in WIDE
    n_channels = 1 if wide else CHANNELS.get(message.encoding)
    if n_channels is None:
        raise RecordingError(
            f"pictures of encoding '{message.encoding}' cannot be read", remedy="record mono8, bgr8 or rgb8"
        )
    rows = np.frombuffer(message.data, np.uint8)
    n_bytes = message.width * n_channels * (2 if wide else 1)
    if len(rows) < message.height * message.step or message.step < n_bytes or not message.height * message.width:
        raise RecordingError("a picture holds fewer bytes than its size", remedy="the message is damaged; record again")
    pixels = rows[: message.height * message.step].reshape(message.height, message.step)[:, :n_bytes]
    if wide:
        high = pixels[:, 0::2] if message.is_bigendian else pixels[:, 1::2]
        return Image(stamp_ns, np.ascontiguousarray(high), "mono8", message.header.frame_id)
    if n_channels > 1:
        pixels = pixels.reshape(message.height, message.width, n_channels)[..., :3]
    return Image(stamp_ns, pixels, NAMES.get(message.encoding, message.encoding), message.header.frame_id)


def read_compressed_image(message: Any, stamp_ns: int) -> Image:
    """Return the picture of a sensor_msgs/CompressedImage, mono8 or rgb8."""
    from PIL import Image as Picture

    try:
        with Picture.open(io.BytesIO(bytes(message.data))) as picture:
            _refuse_large(*picture.size)  # before a pixel is decoded
            gray = picture.mode in ("L", "1", "I", "I;16")
            if picture.mode in ("I", "I;16"):
                pixels = (np.asarray(picture).astype(np.uint16) >> 8).astype(np.uint8)
            else:
                pixels = np.array(picture.convert("L" if gray else "RGB"))
    except RecordingError:
        raise
    except Exception as error:  # Pillow's decoders each raise their own on damaged bytes, and for bombs
        raise RecordingError(
            f"a compressed picture ('{message.format}') cannot be read ({one_line(error)})",
            remedy="record png or jpeg",
        ) from error
    return Image(stamp_ns, pixels, "mono8" if gray else "rgb8", message.header.frame_id)


def _refuse_large(width: int, height: int) -> None:
    if width * height > MAX_PIXELS:
        what = f"a compressed picture is {width} x {height} pixels, over {MAX_PIXELS // 10**6} million"
        raise RecordingError(what, remedy="the message is damaged; record again")


def encode_picture(image: Image, kind: str = "png", quality: int = 90) -> bytes:
    """Encode a picture as PNG (lossless) or JPEG bytes."""
    from PIL import Image as Picture

    pixels = image.pixels[..., ::-1] if image.encoding == "bgr8" else image.pixels
    out = io.BytesIO()
    options: dict[str, Any] = {"quality": quality} if kind == "jpeg" else {"compress_level": 1}
    Picture.fromarray(np.ascontiguousarray(pixels)).save(out, kind.upper(), **options)
    return out.getvalue()
