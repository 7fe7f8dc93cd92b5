"""Files of plain arrays: what was written is read, and nothing else is."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest

from replay.storage.arrays import read_arrays


def test_what_was_written_is_read(tmp_path: Path) -> None:
    written = {"a.b": np.arange(6.0).reshape(2, 3), "none": np.zeros((0, 2)), "text": np.array("x")}
    np.savez(tmp_path / "file.npz", **written)
    result = read_arrays(tmp_path / "file.npz")
    assert sorted(result) == sorted(written)
    for name, array in written.items():
        assert (result[name].dtype, result[name].shape) == (array.dtype, array.shape)
        assert result[name].tobytes() == array.tobytes()
    with pytest.raises(FileNotFoundError):
        read_arrays(tmp_path / "other.npz")


def test_members_that_share_bytes_are_refused(tmp_path: Path) -> None:
    """A small file whose directory names its one array many times would fill the memory."""
    path = tmp_path / "file.npz"
    np.save(tmp_path / "a.npy", np.zeros(1000))
    with zipfile.ZipFile(path, "w") as archive:
        archive.write(tmp_path / "a.npy", "a.npy")
        archive.filelist += archive.infolist() * 50
    with pytest.raises(ValueError, match="its arrays overlap, or are compressed"):
        read_arrays(path)
    np.savez_compressed(path, a=np.zeros(1000))
    with pytest.raises(ValueError, match="its arrays overlap, or are compressed"):
        read_arrays(path)
