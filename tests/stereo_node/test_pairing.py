"""Left and right pictures of one moment: pairs, offsets, and what is said where there are none."""

import numpy as np
import pytest

from livedeform.common.stamps import StampGate
from livedeform.common.types import Image
from livedeform.stereo_node.pairing import LATE, PicturePairs, recorded_pairs
from livedeform.stereo_node.picture_checks import BadPictures, PictureChecks
from livedeform.stereo_node.warm_up import _rig

MS = 1_000_000
RIG = _rig()


def feed(pairs, offset_ns, n=20, jitter_ns=0, rate_ns=33 * MS, missing=()):
    """Alternating pictures; ``missing``: numbers of right ones that never come. Returns the pairs."""
    rng, out = np.random.default_rng(1), []
    for k in range(n):
        late = offset_ns + int(rng.uniform(-1, 1) * jitter_ns)
        out += pairs.add_left(Image(k * rate_ns, np.zeros((1, 1), np.uint8)))
        if k not in missing:
            out += pairs.add_right(Image(k * rate_ns + late, np.zeros((1, 1), np.uint8)))
    return out


def test_pictures_within_the_tolerance_are_pairs_and_their_offset_is_told():
    pairs = PicturePairs(5 * MS)
    found = feed(pairs, 2 * MS, jitter_ns=MS, missing=(3, 11))
    assert len(found) == pairs.n_pairs == 18 and pairs.n_unpaired == 2
    assert all(abs(right.stamp_ns - left.stamp_ns - 2 * MS) <= MS for left, right in found)
    assert pairs.offset == pytest.approx(2e-3, abs=5e-4)  # of 18 with a jitter of 1 ms
    assert pairs.trouble == ""


@pytest.mark.parametrize("offset_ns", [12 * MS, -9 * MS])
def test_an_offset_beyond_the_tolerance_is_told_and_can_be_allowed_for(offset_ns):
    pairs = PicturePairs(5 * MS)
    assert feed(pairs, offset_ns) == []
    assert pairs.offset == pytest.approx(offset_ns * 1e-9)
    assert f"{offset_ns / MS:+.1f} ms apart and the tolerance is 5 ms" in pairs.trouble
    allowed = PicturePairs(5 * MS, expected_ns=offset_ns)
    assert len(feed(allowed, offset_ns)) >= 19 and allowed.trouble == ""  # at an end one may wait for its partner
    assert allowed.offset == pytest.approx(offset_ns * 1e-9)


def test_a_camera_that_is_missing_or_stops_is_named():
    pairs = PicturePairs()
    assert feed(pairs, 0, n=LATE, missing=range(LATE)) == []
    assert "5 left pictures came without a right one" in pairs.trouble
    stopped = PicturePairs()
    assert len(feed(stopped, 0, n=20, missing=range(10, 20))) == 10
    assert "10 left pictures came without a right one" in stopped.trouble
    assert len(stopped.add_right(Image(19 * 33 * MS, np.zeros((1, 1), np.uint8)))) == 1 and stopped.trouble == ""


def test_what_waits_is_bounded():
    pairs = PicturePairs(capacity=10)
    feed(pairs, 0, n=50, missing=range(50))
    assert pairs.n_unpaired == 40


def test_recorded_pictures_are_paired_whatever_one_side_lacks():
    def pictures(numbers, late_ns=0):
        return [Image(k * 33 * MS + late_ns, np.zeros((1, 1), np.uint8)) for k in numbers]

    left, right = pictures(range(3, 40)), pictures([*range(12), *range(20, 30), 37], late_ns=2 * MS)
    found = [(a.stamp_ns // (33 * MS), b.stamp_ns // (33 * MS)) for a, b in recorded_pairs(left, right)]
    assert found == [(k, k) for k in [*range(3, 12), *range(20, 30), 37]]


@pytest.mark.parametrize("fps", [30, 120, 200, 240, 500, 1000])
@pytest.mark.parametrize(
    ("no_left", "no_right"),
    [((), (100,)), ((100,), (101,)), ((), (0,)), ((0, 1), (2,)), (range(50, 60), (60, 61)), (range(1, 300, 2), ())],
)
def test_a_lost_picture_never_pairs_others_with_another_moment(fps, no_left, no_right):
    """One camera lacks some, also where they follow each other within the tolerance: every pair is of one moment."""
    n = 400
    late = MS // 10  # the right camera's stamps
    stamps = [10**18 + round(k * 1e9 / fps) for k in range(n)]
    left = [Image(s, np.zeros((1, 1), np.uint8)) for k, s in enumerate(stamps) if k not in no_left]
    right = [Image(s + late, np.zeros((1, 1), np.uint8)) for k, s in enumerate(stamps) if k not in no_right]
    lost = len({*no_left} | {*no_right})
    live, found = PicturePairs(), []
    arriving = [(a, live.add_left) for a in left] + [(b, live.add_right) for b in right]
    for image, add in sorted(arriving, key=lambda arrival: arrival[0].stamp_ns):
        found += add(image)
    for pairs in (found, list(recorded_pairs(left, right))):
        assert [b.stamp_ns - a.stamp_ns for a, b in pairs] == [late] * (n - lost)
    assert live.trouble == ""


def test_stamps_too_far_apart_for_their_rate_are_told():
    pairs = PicturePairs()
    assert feed(pairs, 18 * MS // 10, n=30, rate_ns=4 * MS) == []  # almost between two of the other camera
    assert "+1.8 ms apart and the tolerance is 5 ms, or 1.6 ms so soon after each other" in pairs.trouble
    assert "pair_offset" in pairs.trouble and "pair_tolerance" not in pairs.trouble
    allowed = PicturePairs(expected_ns=2 * MS)
    assert len(feed(allowed, 2 * MS, n=30, rate_ns=4 * MS, missing=(7,))) == 29 and allowed.trouble == ""
    assert allowed.offset == pytest.approx(2e-3)


def test_the_only_pair_of_a_recording_is_one():
    left, right = ([Image(late, np.zeros((1, 1), np.uint8))] for late in (0, 2 * MS))
    assert [(a.stamp_ns, b.stamp_ns) for a, b in recorded_pairs(left, right)] == [(0, 2 * MS)]


FRAME = 33 * MS
SECOND = 1000 * MS
JUMPS = {
    "one ahead": lambda k: 15 * SECOND * (k == 100), "one back": lambda k: -15 * SECOND * (k == 100),
    "set ahead": lambda k: 15 * SECOND * (k >= 100), "set back": lambda k: -15 * SECOND * (k >= 100),
    "set back a second": lambda k: -SECOND * (k >= 100), "set back an hour": lambda k: -3600 * SECOND * (k >= 100),
}  # fmt: skip


@pytest.mark.parametrize("lost", [(), (99,), (98, 99, 101)])
@pytest.mark.parametrize(
    ("jump", "side"),
    [(jump, side) for jump in JUMPS for side in ("left", "right", "both") if side == "both" or jump.startswith("one")],
)
def test_a_stamp_that_jumps_costs_its_own_pair(jump: str, side: str, lost: tuple[int, ...]):
    """And a clock that is set, its first two: also where pictures of the other camera wait or were lost."""
    live, checks = PicturePairs(), PictureChecks(RIG, 6.0, refuse_frozen=True)
    gates, rng, good = (StampGate[Image](), StampGate[Image]()), np.random.default_rng(4), []
    numbers = range(90, 120)
    for k in numbers:
        for which, add in enumerate((live.add_left, live.add_right)):
            if which == 1 and k in lost:
                continue
            by = JUMPS[jump](k) if side in ("both", ("left", "right")[which]) else 0
            picture = rng.integers(0, 255, (480, 640)).astype(np.uint8)
            picture[0, 0] = k
            image = Image(10**18 + k * FRAME + by, picture)
            for admitted in gates[which].admit(image.stamp_ns, image):
                for a, b in add(admitted):
                    try:
                        checks.grey_pair(a, b)
                    except BadPictures:
                        continue
                    assert a.pixels[0, 0] == b.pixels[0, 0]  # of one moment
                    good.append(int(a.pixels[0, 0]))
    missing = set(numbers) - set(good) - set(lost)
    assert good == sorted(good) and missing <= {100, 101, 102}
    assert len(missing) <= (1 if jump.startswith("one") else 2)  # measured 1 and 2; a clock set by an hour costs none


def test_the_first_pair_is_one_if_no_other_picture_comes_for_a_while():
    pairs = PicturePairs()
    left, right = (Image(late, np.zeros((1, 1), np.uint8)) for late in (0, 2 * MS))
    assert pairs.add_left(left) == [] and pairs.lone() == []
    assert pairs.add_right(right) == []  # another moment's, if the cameras take five hundred a second
    assert pairs.lone() == [] and pairs.lone() == [(left, right)]
    assert pairs.lone() == [] and (pairs.n_pairs, pairs.n_unpaired) == (1, 0)
    a, b = (Image(10_000 * MS + late, np.zeros((1, 1), np.uint8)) for late in (0, 2 * MS))
    assert pairs.add_left(a) == [] and pairs.add_right(b) == [(a, b)]  # and the next one waits for nothing
