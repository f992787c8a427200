"""Adapting the detector to what the identified markers look like: it is faster, and sees less else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from livedeform.stereo_node.detect.blobs import Blobs
from livedeform.stereo_node.detect.candidates import find_candidates
from livedeform.stereo_node.detect.picture import Picture
from livedeform.stereo_node.detect.settings import DetectorSettings

NEAR_PX = 2.0  # a candidate that near to a marker's centre is the marker


def strongest(blobs: Blobs, most: int) -> Blobs:
    """Return the ``most`` blobs that stand out most from the misfit of their fits.

    Before the markers' looks are known, a textured ground offers thousands of weak ones. Coded markers all stay.
    """
    if len(blobs) <= most or blobs.codes is not None:
        return blobs
    strength = np.abs(blobs.contrasts) / np.maximum(blobs.residuals, 1.0)
    return blobs.take(np.sort(np.argsort(-strength)[:most]))


def adapted(given: DetectorSettings, pictures: Sequence[Picture], seen: Sequence[Blobs]) -> DetectorSettings:
    """Narrow ``given`` to twice the range of what the markers ``seen`` in each of the ``pictures`` look like.

    Of the searches (width of the surroundings, half or full size) it takes the cheapest that finds all of them.
    """
    learned = _narrowed(given, seen)
    for width in (given.surroundings[:1], given.surroundings[1:2], given.surroundings):
        for step in (2, 1):
            search = replace(learned, surroundings=width, search_step=step)
            if width and all(_finds(p, search, b) for p, b in zip(pictures, seen, strict=True)):
                return search
    return learned


def _narrowed(given: DetectorSettings, seen: Sequence[Blobs]) -> DetectorSettings:
    radii = np.concatenate([b.radii for b in seen])
    contrasts = np.concatenate([b.contrasts for b in seen])
    dark = contrasts < 0
    return replace(
        given,
        min_radius=max(given.min_radius, 0.5 * float(radii.min())),
        max_radius=min(given.max_radius, 2.0 * float(radii.max())),
        polarity="dark" if dark.all() else "light" if not dark.any() else "both",
        min_contrast=max(given.min_contrast, 0.35 * float(np.median(np.abs(contrasts)))),
        levels=1,
    )


def _finds(picture: Picture, settings: DetectorSettings, wanted: Blobs) -> bool:
    """Tell whether the search alone finds all of ``wanted``."""
    found = find_candidates(picture, settings)[0]
    if not len(found):
        return False
    distance = np.linalg.norm(wanted.centres[:, None] - found[None], axis=2)
    return bool(distance.min(axis=1).max() < NEAR_PX)
