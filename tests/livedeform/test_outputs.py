"""Output folders."""

from pathlib import Path

import pytest

from livedeform.outputs import prepared


def test_what_fails_leaves_no_empty_folders(tmp_path: Path) -> None:
    with pytest.raises(ValueError), prepared(tmp_path / "new" / "out", ("a.json",), force=False):
        raise ValueError
    assert not list(tmp_path.iterdir())


def test_what_fails_leaves_what_is_written_and_what_was_there(tmp_path: Path) -> None:
    old = tmp_path / "old"
    old.mkdir()
    with pytest.raises(ValueError), prepared(old, ("a.json",), force=False):
        raise ValueError
    with pytest.raises(ValueError), prepared(old / "out", ("a.json",), force=False):
        (old / "out" / "part.txt").write_text("half")
        raise ValueError
    assert (old / "out" / "part.txt").is_file()
