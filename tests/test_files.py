"""A file is whole or not there."""

from pathlib import Path

import numpy as np
import pytest

from warprrf.files import write_arrays, write_atomically, write_text


@pytest.mark.parametrize("error", [OSError("disk full"), KeyboardInterrupt()])
def test_a_failed_write_leaves_the_old_file(tmp_path: Path, error: BaseException) -> None:
    path = tmp_path / "kept.txt"
    path.write_text("old")

    def broken(file: Path) -> None:
        file.write_text("half")
        raise error

    with pytest.raises(type(error)):
        write_atomically(path, broken)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_the_file_is_written_beside_its_place_under_its_suffix(tmp_path: Path) -> None:
    path = tmp_path / "new" / "folder" / "field.v2.nc"
    seen: list[Path] = []
    write_atomically(
        path, lambda file: (seen.append(file), file.write_bytes(b"data"), path.exists() and 1 / 0)
    )
    assert path.read_bytes() == b"data"
    assert seen[0].parent == path.parent and seen[0].suffix == ".nc" and not seen[0].exists()


def test_text_and_arrays_come_back(tmp_path: Path) -> None:
    write_text(tmp_path / "a.txt", "größer")
    assert (tmp_path / "a.txt").read_bytes() == "größer".encode()
    write_arrays(tmp_path / "a.bin", {"x": np.arange(3), "y": np.eye(2)})
    with np.load(tmp_path / "a.bin") as found:
        assert sorted(found) == ["x", "y"] and np.array_equal(found["x"], np.arange(3))
