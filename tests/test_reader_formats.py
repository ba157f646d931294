"""Formats of keypoints and bodies that other packages bring, by entry points."""

import json
import logging
import textwrap
from pathlib import Path

import numpy as np
import pytest

from bodyslam_jax.io.bodies.body_format import body_formats
from bodyslam_jax.io.bodies.reader import read_bodies
from bodyslam_jax.io.keypoints.keypoint_format import keypoint_formats
from bodyslam_jax.io.keypoints.reader import read_detections
from bodyslam_jax.types import Intrinsics

NUM, WIDTH, HEIGHT = 6, 640, 480
CAMERA = Intrinsics(np.array([500.0, 500.0, 319.5, 239.5]), WIDTH, HEIGHT)
NAMES = (
    "nose left_shoulder right_shoulder left_elbow right_elbow left_wrist right_wrist "
    "left_hip right_hip left_knee right_knee left_ankle right_ankle"
).split()
BODY25 = [0, 5, 2, 6, 3, 7, 4, 12, 9, 13, 10, 14, 11]
"""Of each of these names."""

PACKAGE = f"""
    import numpy as np

    from bodyslam_jax.io.bodies.body_format import BodyFormat
    from bodyslam_jax.io.bodies.parts import Rows
    from bodyslam_jax.io.files import read_csv
    from bodyslam_jax.io.keypoints.keypoint_format import KeypointFormat, Listed


    class Tables(KeypointFormat):
        name = "tables"
        layout = {tuple(NAMES)!r}
        suffixes = (".csv",)

        def recognises(self, source):
            return source.path.suffix == ".csv"

        def read(self, source, num_frames):
            table = np.array(read_csv(source.path), dtype=float)
            rows = [(str(k), row.reshape(-1, 3), -1) for k, row in enumerate(table)]
            return Listed(rows, [name for name, _, _ in rows])


    class Standing(BodyFormat):
        name = "standing"
        layout = ("where", "who")

        def read(self, source, video):
            trans = np.asarray(source.content["where"], dtype=float)
            n = len(trans)
            none = np.zeros((n, 72)), np.zeros((n, 10))
            return Rows(np.arange(n), np.zeros(n, np.int64), *none, trans)


    class Other:
        pass
"""
ENTRIES = """
    [bodyslam_jax.keypoint_formats]
    broken = reader_of_a_test:Nothing
    other = reader_of_a_test:Other
    tables = reader_of_a_test:Tables

    [bodyslam_jax.body_formats]
    standing = reader_of_a_test:Standing
"""


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """A package with formats, as an installer leaves it."""
    home = tmp_path / "site"
    facts = home / "reader_of_a_test-1.0.dist-info"
    facts.mkdir(parents=True)
    (facts / "METADATA").write_text("Name: reader-of-a-test\nVersion: 1.0\n")
    (facts / "entry_points.txt").write_text(textwrap.dedent(ENTRIES))
    (home / "reader_of_a_test.py").write_text(textwrap.dedent(PACKAGE))
    monkeypatch.syspath_prepend(home)


def table(path: Path) -> np.ndarray:
    rng = np.random.default_rng(0)
    points = rng.uniform(100.0, 400.0, (NUM, len(NAMES), 3))
    points[..., 2] = 0.9
    lines = (",".join(map(str, row.ravel().tolist())) for row in points)
    path.write_text("\n".join(lines) + "\n")
    return points


def read(path: Path):
    return read_detections(path, num_frames=NUM, width=WIDTH, height=HEIGHT)


def test_keypoints_of_another_packages_format(tmp_path, installed):
    points = table(tmp_path / "a.csv")
    found = np.stack([f[0] for f in read(tmp_path / "a.csv").points])
    np.testing.assert_allclose(found[:, BODY25], points)
    assert found[:, [15, 16, 19], 2].max() == 0


def test_without_the_package_the_file_is_refused(tmp_path):
    table(tmp_path / "a.csv")
    with pytest.raises(ValueError, match="a.csv, line 1: not JSON") as caught:
        read(tmp_path / "a.csv")
    assert "\n" not in str(caught.value)


def test_bodies_of_another_packages_format(tmp_path, installed):
    where = np.tile([0.1, 0.2, 4.0], (NUM, 1))
    np.savez(tmp_path / "b.npz", where=where, who=np.zeros(1))
    found = read_bodies(tmp_path / "b.npz", num_frames=NUM, intrinsics=CAMERA)
    np.testing.assert_array_equal(found.trans[0], where)


def test_whatever_another_packages_reader_raises_names_the_file(tmp_path, installed):
    (tmp_path / "a.csv").write_text("1,2,three\n")
    with pytest.raises(ValueError, match="damaged keypoints of tables") as caught:
        read(tmp_path / "a.csv")
    assert "a.csv" in str(caught.value) and "\n" not in str(caught.value)
    np.savez(tmp_path / "b.npz", where=np.zeros(3), who=np.zeros(1))
    with pytest.raises(ValueError, match="b.npz"):
        read_bodies(tmp_path / "b.npz", num_frames=NUM, intrinsics=CAMERA)


def test_what_is_no_format_is_left_out_with_a_warning(tmp_path, installed, caplog):
    with caplog.at_level(logging.WARNING):
        names = [f.name for f in keypoint_formats()]
    assert names[-1] == "tables" and "OpenPose" in names
    said = [r.getMessage() for r in caplog.records]
    assert any("format broken" in text and "AttributeError" in text for text in said)
    assert any("format other" in text and "KeypointFormat" in text for text in said)


def test_other_packages_come_last(tmp_path, installed):
    """What is installed does not change how a known file is read."""
    assert [f.name for f in body_formats()][-1] == "standing"
    people = {"people": [{"pose_keypoints_2d": [200.0, 200.0, 0.9] * 25}]}
    for k in range(NUM):
        name = f"a_{k:06d}_keypoints.json"
        (tmp_path / name).write_text(json.dumps(people))
    assert [len(f) for f in read(tmp_path).points] == [1] * NUM
