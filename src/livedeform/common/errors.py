"""The errors that a user may see: each says what is wrong, where, and what to do about it."""

from __future__ import annotations

__all__ = ["CalibrationError", "ConvergenceError", "InputError", "LivedeformError", "MeshError", "RecordingError"]


class LivedeformError(Exception):
    """Base of every expected error.

    Parameters
    ----------
    what : str
        What is wrong, as a sentence without the final full stop.
    where : str
        File, key, topic, or place on the body; empty if there is none.
    remedy : str
        What the user can do.
    """

    def __init__(self, what: str, *, where: str = "", remedy: str = "") -> None:
        self.what, self.where, self.remedy = what, where, remedy
        text = f"{where}: {what}" if where else what
        line = f"{text}; {remedy}" if remedy else text
        super().__init__(" ".join(line.splitlines()))


class InputError(LivedeformError):
    """A file, a value or an argument of the user's is wrong (exit code 2)."""


class RecordingError(InputError):
    """A bag cannot be read or written."""


class MeshError(InputError):
    """A surface or a mesh cannot be used as it is."""


class CalibrationError(InputError):
    """A camera calibration is missing, implausible, or of another camera."""


class ConvergenceError(LivedeformError):
    """A nonlinear solution was not found.

    ``where`` names the load step and the place on the body.
    """
