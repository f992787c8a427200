"""Pairs of pictures of a calibration board, from files, two videos or a bag, whatever their names."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path

from livedeform.common import topics as t
from livedeform.common.bags.read import read_bag
from livedeform.common.bags.recording import load_recording
from livedeform.common.errors import CalibrationError
from livedeform.stereo_node.boards.find_pairs import read_picture
from livedeform.stereo_node.boards.videos import is_video, video_pairs
from livedeform.stereo_node.detect.picture import Picture, grey
from livedeform.stereo_node.pairing import recorded_pairs

Say = Callable[[str], None]
Pictures = list[tuple[str, Picture, Picture]]
MOST_FROM_BAG = 40


def picture_files(left: str, right: str) -> Pictures:
    """Pairs of pictures of two glob patterns, by the numbers in their names that change from file to file."""
    files = []
    for option, pattern in (("--left", left), ("--right", right)):
        path = Path(pattern)
        found = sorted(path.parent.glob(path.name))
        if not found:
            raise CalibrationError(
                "no such pictures", where=f"{option} {pattern}", remedy="check the path, and quote the pattern"
            )
        files.append(found)
    keys = [_numbers(side) for side in files]
    bare = [[tuple(n.lstrip("0") for n in key) for key in side] for side in keys]
    if set(keys[0]) != set(keys[1]) and set(bare[0]) == set(bare[1]):
        keys = bare  # 01 on one side is 1 on the other
    if len(files[0]) == len(files[1]) and not all(all(side) for side in keys):
        pairs = list(zip(*files, strict=True))  # no numbers: in the order of their names
    else:
        _refuse_alone(files, keys)
        rights = dict(zip(keys[1], files[1], strict=True))
        lefts = dict(zip(keys[0], files[0], strict=True))
        pairs = [(lefts[k], rights[k]) for k in sorted(lefts, key=lambda key: [int(n) for n in key])]
    return [(a.name, read_picture(str(a)), read_picture(str(b))) for a, b in pairs]


def _numbers(files: Sequence[Path]) -> list[tuple[str, ...]]:
    """Return each file's numbers, without those that all files share (which camera it was, a date)."""
    groups = [tuple(re.findall(r"\d+", f.stem)) for f in files]
    if len(files) < 2 or len({len(g) for g in groups}) > 1:
        return groups
    change = [k for k in range(len(groups[0])) if len({g[k] for g in groups}) > 1]
    return [tuple(g[k] for k in change) for g in groups]


def _refuse_alone(files: Sequence[Sequence[Path]], keys: Sequence[Sequence[tuple[str, ...]]]) -> None:
    """Raise ``CalibrationError`` where a number is on one side only, or twice on one."""
    odd = sorted(set(keys[0]) ^ set(keys[1]))
    if not odd and all(len(set(side)) == len(side) for side in keys):
        return
    which = f"number {' '.join(odd[0])} is on one side only" if odd else "a number is there twice"
    raise CalibrationError(
        f"{len(files[0])} left and {len(files[1])} right pictures, {which}",
        where="--left, --right",
        remedy="give every left picture a right one with the same number",
    )


def named_pictures(
    left: str | None, right: str | None, bag: Path | None, prefix: str = "--", *, shift: float | None = None,
    say: Say | None = None,
) -> Pictures:  # fmt: skip
    """The pictures that the options ``prefix``left and right (patterns, or one video each), or bag, name."""
    if bag is not None and (left is not None or right is not None):
        raise CalibrationError(
            "pictures are named twice",
            where=f"{prefix}bag",
            remedy=f"give {prefix}left and {prefix}right, or {prefix}bag",
        )
    if bag is not None:
        return bag_pictures(bag)
    if left is None or right is None:
        missing = f"{prefix}left" if left is None else f"{prefix}right"
        raise CalibrationError(
            "no pictures are named", where=missing, remedy=f"give {prefix}left and {prefix}right, or {prefix}bag"
        )
    if is_video(left) or is_video(right):
        pairs, line = video_pairs(Path(left), Path(right), shift)
        if say is not None:
            say(line)
        return pairs
    return picture_files(left, right)


def bag_pictures(path: Path) -> Pictures:
    """Up to ``MOST_FROM_BAG`` pairs of a recording, spread evenly over it."""
    recording = load_recording(path)
    with read_bag(path) as bag:
        counts = [bag.topics[name].count for name in (t.LEFT_IMAGE, t.LEFT_COMPRESSED) if name in bag.topics]
    stride = max(1, (counts[0] if counts else 1) // MOST_FROM_BAG)
    out = []
    for seen, (a, b) in enumerate(recorded_pairs(recording.left, recording.right)):
        if seen % stride == 0:
            out.append((f"{a.stamp_ns * 1e-9:.3f} s", grey(a.pixels, a.encoding), grey(b.pixels, b.encoding)))
    if not out:
        raise CalibrationError(
            "holds no pairs of stereo pictures", where=str(path), remedy="record both cameras' image topics"
        )
    return out
