"""Pairs of pictures of a calibration board, from files, two videos or a bag, whatever their names."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path

from livedeform.common import topics as t
from livedeform.common.bags.read import read_bag
from livedeform.common.bags.recording import load_recording, picture_topic
from livedeform.common.errors import CalibrationError
from livedeform.stereo_node.boards.find_pairs import read_picture
from livedeform.stereo_node.boards.videos import is_video, video_pairs
from livedeform.stereo_node.detect.picture import Picture, grey
from livedeform.stereo_node.pairing import recorded_pairs

Say = Callable[[str], None]
Pictures = list[tuple[str, Picture, Picture]]
Key = tuple[int, ...]
MOST_FROM_BAG = 40


def picture_files(left: str, right: str, say: Say | None = None) -> Pictures:
    """Pairs of pictures of two glob patterns, by the numbers in their names that change from file to file.

    A pair with a file that is no picture is left out and said to ``say``; without it, or where no pair remains,
    ``CalibrationError``.
    """
    files = []
    for option, pattern in (("--left", left), ("--right", right)):
        path = Path(pattern)
        found = sorted(path.parent.glob(path.name))
        if not found:
            raise CalibrationError(
                "no such pictures", where=f"{option} {pattern}", remedy="check the path, and quote the pattern"
            )
        files.append(found)
    pictures: Pictures = []
    broken: list[CalibrationError] = []
    for a, b in _paired(*files):
        try:
            pictures.append((a.name, read_picture(str(a)), read_picture(str(b))))
        except CalibrationError as error:
            if say is None:
                raise
            broken.append(error)
    if not pictures:
        raise broken[0]
    if say is not None:
        for one in broken:
            say(f"{one.where}: cannot be read as a picture; its pair is left out")
    return pictures


def _paired(left: Sequence[Path], right: Sequence[Path]) -> list[tuple[Path, Path]]:
    """Return the files that belong together, in the order of their numbers."""
    files = left, right
    names = [_numbers(side) for side in files]
    if len(left) == len(right) and not all(all(side) for side in names):
        return list(zip(left, right, strict=True))  # no numbers: in the order of their names
    keys = [[tuple(int(n) for n in key) for key in side] for side in names]  # 01 on one side is 1 on the other
    keys = _one_number(keys) or keys
    _refuse_alone(files, names, keys)
    lefts, rights = (dict(zip(k, f, strict=True)) for k, f in zip(keys, files, strict=True))
    return [(lefts[k], rights[k]) for k in sorted(lefts)]


def _numbers(files: Sequence[Path]) -> list[tuple[str, ...]]:
    """Return each file's numbers, without those that all files share (which camera it was, a date)."""
    groups = [tuple(re.findall(r"\d+", f.stem)) for f in files]
    if len(files) < 2 or len({len(g) for g in groups}) > 1:
        return groups
    change = [k for k in range(len(groups[0])) if len({g[k] for g in groups}) > 1]
    return [tuple(g[k] for k in change) for g in groups]


def _one_number(keys: Sequence[Sequence[Key]]) -> list[list[Key]] | None:
    """Return keys of one number each, the first that is the same on both sides and tells their files apart, where the
    whole ones differ: each camera may also write down its own clock. None where there is none."""
    if set(keys[0]) == set(keys[1]) or any(len({len(key) for key in side}) > 1 for side in keys):
        return None
    for i in range(len(keys[0][0])):
        for j in range(len(keys[1][0])):
            one = [[key[k : k + 1] for key in side] for side, k in zip(keys, (i, j), strict=True)]
            if set(one[0]) == set(one[1]) and all(len(set(side)) == len(side) for side in one):
                return one
    return None


def _refuse_alone(
    files: Sequence[Sequence[Path]], names: Sequence[Sequence[tuple[str, ...]]], keys: Sequence[Sequence[Key]]
) -> None:
    """Raise ``CalibrationError`` where a number is on one side only, or twice on one."""
    odd = set(keys[0]) ^ set(keys[1])
    if not odd and all(len(set(side)) == len(side) for side in keys):
        return
    alone = [
        f"number {' '.join(name)}" if name else file.name
        for side in zip(files, names, keys, strict=True)
        for file, name, key in zip(*side, strict=True)
        if key in odd
    ]
    which = f"{min(alone)} is on one side only" if odd else "a number is there twice"
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
    if is_video(left) != is_video(right):
        raise CalibrationError(
            "one is a video, the other is not",
            where=f"{prefix}left, {prefix}right",
            remedy="give two videos, or two patterns of pictures",
        )
    if is_video(left):
        pairs, line = video_pairs(Path(left), Path(right), shift)
        if say is not None:
            say(line)
        return pairs
    return picture_files(left, right, say)


def bag_pictures(path: Path) -> Pictures:
    """Up to ``MOST_FROM_BAG`` pairs of a recording, spread evenly over it."""
    recording = load_recording(path)
    with read_bag(path) as bag:
        name = picture_topic(bag, t.LEFT_IMAGE)
        stride = max(1, (bag.topics[name].count if name is not None else 1) // MOST_FROM_BAG)
    out = []
    for seen, (a, b) in enumerate(recorded_pairs(recording.left, recording.right)):
        if seen % stride == 0:
            out.append((f"{a.stamp_ns * 1e-9:.3f} s", grey(a.pixels, a.encoding), grey(b.pixels, b.encoding)))
    if not out:
        raise CalibrationError(
            "holds no pairs of stereo pictures", where=str(path), remedy="record both cameras' image topics"
        )
    return out
