"""Draws one picture of each stereo check, from what the benchmark left behind.

python benchmarks/stereo_accuracy.py --presses 1 --pictures out/checks
python docs/make_stereo_checks.py out/checks docs/img/stereo_checks.png
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

TILE = 360, 258  # px
CAPTION = 26  # px
COLUMNS = 3
CHECKS = {
    "discs": ("rendered discs, noise 2", 0.35),
    "tags": ("rendered AprilTags", 0.9),
    "board_checkerboard": ("rendered checkerboard", 1.0),
    "dome_flat": ("dome, flat discs", 0.4),
    "dome_painted": ("dome, painted discs", 0.4),
    "internal": ("markers inside a transparent body", 0.4),
    "texture": ("textured ground", 0.4),
    "identities": ("a press that hides a third", 0.55),
    "checkerboard": ("published checkerboard", 1.0),
    "dots": ("published dot cylinder", 0.5),
    "soft_phantom_pressed": ("soft phantom, pressed", 0.8),
}
"""Name of the benchmark's picture: caption, and the share of the picture's width that is shown."""


def tile(picture: NDArray[np.uint8], caption: str, share: float) -> NDArray[np.uint8]:
    """The middle of what was marked in the picture, with its caption below."""
    h, w = picture.shape[:2]
    width = share * w
    height = width * TILE[1] / TILE[0]
    marked = np.argwhere((picture[..., 2].astype(int) - picture[..., 0]) > 120)
    middle = marked.mean(axis=0)[::-1] if len(marked) else np.array([w / 2, h / 2])
    x = int(np.clip(middle[0] - width / 2, 0, max(w - width, 0)))
    y = int(np.clip(middle[1] - height / 2, 0, max(h - height, 0)))
    crop = picture[y : y + round(height), x : x + round(width)]
    scale = min(TILE[0] / crop.shape[1], TILE[1] / crop.shape[0])
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    small = cv2.resize(crop, None, fx=scale, fy=scale, interpolation=how)
    out = np.full((TILE[1] + CAPTION, TILE[0], 3), 255, np.uint8)
    left = (TILE[0] - small.shape[1]) // 2
    out[: small.shape[0], left : left + small.shape[1]] = small
    cv2.putText(out, caption, (4, TILE[1] + 19), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (40, 40, 40), 1, cv2.LINE_AA)
    return out


def main() -> None:
    """The sheet of all pictures that there are."""
    folder, target = Path(sys.argv[1]), Path(sys.argv[2])
    tiles = []
    for name, (caption, share) in CHECKS.items():
        picture = cv2.imread(str(folder / f"{name}.png"))
        if picture is None:
            print(f"no {name}.png in {folder}: left out")
            continue
        tiles.append(tile(picture.astype(np.uint8), caption, share))
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % COLUMNS)
    rows = [np.hstack(tiles[k : k + COLUMNS]) for k in range(0, len(tiles), COLUMNS)]
    cv2.imwrite(str(target), np.vstack(rows), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    print(f"{target}: {len(tiles)} tiles")


if __name__ == "__main__":
    main()
