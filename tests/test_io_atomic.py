"""Files are complete or not there at all."""

import numpy as np
import pytest

from bodyslam_jax.io import atomic


def test_a_file_is_replaced_in_one_step(tmp_path):
    path = tmp_path / "a.txt"
    atomic.write_text(path, "old")
    with atomic.replacing(path) as partial:
        partial.write_text("new")
        assert partial.parent == tmp_path and partial.suffix == ".txt"
        assert path.read_text() == "old"
    assert path.read_text() == "new" and list(tmp_path.iterdir()) == [path]


def test_an_error_leaves_the_earlier_file(tmp_path):
    path = tmp_path / "a.bin"
    atomic.write_bytes(path, b"old")
    with pytest.raises(RuntimeError), atomic.replacing(path) as partial:
        partial.write_bytes(b"half")
        raise RuntimeError
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("compressed", [True, False])
def test_arrays_are_written_under_the_name_asked_for(tmp_path, compressed):
    path = tmp_path / "arrays.anything"
    atomic.write_npz(path, {"x": np.arange(3)}, compressed=compressed)
    with np.load(path) as archive:
        np.testing.assert_array_equal(archive["x"], np.arange(3))
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("name", ["none/a.txt", "folder"])
def test_an_error_names_the_file_asked_for(tmp_path, name):
    (tmp_path / "folder").mkdir()
    with pytest.raises(OSError) as caught:
        atomic.write_text(tmp_path / name, "text")
    assert caught.value.filename == str(tmp_path / name) and caught.value.strerror
    assert [p.name for p in tmp_path.iterdir()] == ["folder"]


def test_a_hidden_folder_and_what_was_made_for_it_vanish(tmp_path):
    with atomic.hidden_folder(tmp_path / "new" / "home") as partial:
        (partial / "file").write_text("text")
        assert partial.name.startswith(".") and partial.parent.name == "home"
    assert not list(tmp_path.iterdir())
    with atomic.hidden_folder(tmp_path / "new" / "home") as partial:
        (partial.parent / "file").write_text("kept")
    assert (tmp_path / "new" / "home" / "file").exists()
