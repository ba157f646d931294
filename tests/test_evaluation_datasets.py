"""Public data sets, in the layouts that their authors document, on files made here."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
from body_cases import smpl
from dataset_cases import (
    NUM,
    RICH,
    dump,
    emdb_data,
    make_3dpw,
    make_emdb,
    make_images,
    make_pair,
    make_rich,
    make_world,
    threedpw_data,
)

import bodyslam_jax as bs
from bodyslam_jax import evaluation
from bodyslam_jax.body import load_body_model
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.evaluation.datasets import read_truth

pytestmark = pytest.mark.usefixtures("no_body_models")


@pytest.fixture(scope="module")
def body():
    return load_body_model(dtype=jnp.float64)


@pytest.fixture
def world():
    return make_world()


def _check(out, body, world, person=0):
    """The truth that comes out is the world that went in."""
    T_CW, poses, trans, betas = world
    truth = evaluation.read_groundtruth(out, body)
    np.testing.assert_allclose(truth.T_WC, np.linalg.inv(T_CW), atol=1e-7)
    np.testing.assert_allclose(truth.poses[person], poses, atol=1e-12)
    np.testing.assert_allclose(truth.trans[person], trans, atol=1e-12)
    np.testing.assert_allclose(truth.betas[person], betas, atol=1e-12)
    camera = json.loads((out / "camera.json").read_text())
    np.testing.assert_allclose(camera["params"][:4], [50, 52, 31.5, 23.5])
    assert (camera["width"], camera["height"], camera["fps"]) == (64, 48, 30.0)
    return truth


def _expect_joints(found, file, world):
    """SMPL in plain NumPy; the hands of SMPL-X are other joints."""
    _, poses, trans, betas = world
    with np.load(file) as arrays:
        raw = dict(arrays)
    for k, (pose, place) in enumerate(zip(poses, trans, strict=True)):
        expected, _ = smpl(raw, pose, betas, place)
        np.testing.assert_allclose(found[k, :22], expected[:22], atol=1e-9)


def _gender(out, name="body.npz"):
    with np.load(out / "groundtruth" / name) as person:
        return str(person["gender"])


def test_emdb(tmp_path, bodies, body, world):
    """Joints are those of the file's gender, out of a folder with all three."""
    source = make_emdb(tmp_path / "P0", world)
    out = evaluation.convert_emdb(source, tmp_path / "out", bodies)
    truth = _check(out, body, world)
    np.testing.assert_array_equal(truth.present[0], np.arange(NUM) != 2)
    _expect_joints(truth.joints[0], bodies / "SMPL_FEMALE.npz", world)
    assert _gender(out) == "female"
    sequence = bs.read_sequence(out)
    assert sequence.num_frames == NUM and not sequence.intrinsics.is_guess


def test_3dpw(tmp_path, body, world):
    data = threedpw_data(world)
    file = make_3dpw(tmp_path, data)
    out = evaluation.convert_3dpw(file, tmp_path / "out")
    truth = _check(out, body, world, person=1)
    np.testing.assert_array_equal(truth.present[1], np.arange(NUM) != 3)
    own = data["jointPositions"][1].reshape(NUM, 24, 3)
    np.testing.assert_allclose(truth.joints[1], own)
    assert (_gender(out, "body_0.npz"), _gender(out, "body_1.npz")) == (
        "male",
        "female",
    )
    sequence = bs.read_sequence(out)
    assert sequence.keypoints is not None
    assert sequence.keypoints.confidence[:, 0].any()
    assert not sequence.keypoints.confidence[:, 2].any()


def test_rich(tmp_path, bodies, body, world):
    """Each subject has the SMPL-X of its own gender."""
    T_CW, poses, trans, betas = world
    make_rich(tmp_path, world, subjects=("003", "004"))
    out = evaluation.convert_rich(
        tmp_path, "val", RICH, 3, tmp_path / "out", bodies / "smplx"
    )
    poses[:, 66:] = 0
    poses[-1], trans[-1] = 0, 0
    still = np.tile(T_CW[0], (NUM, 1, 1)), poses, trans, betas
    truth = _check(out, body, still)
    np.testing.assert_array_equal(truth.present[0], np.arange(NUM) < NUM - 1)
    for h, gender in enumerate(("FEMALE", "MALE")):
        file = bodies / "smplx" / f"SMPLX_{gender}.npz"
        _expect_joints(truth.joints[h], file, still)
        assert _gender(out, f"body_{h}.npz") == gender.lower()
    camera = json.loads((out / "camera.json").read_text())
    assert camera["model"] == "OPENCV"
    np.testing.assert_allclose(camera["params"][4:], [0.01, -0.002, 0, 0])


def test_tum_with_amass(tmp_path, body, world):
    out = evaluation.convert_tum_amass(*make_pair(tmp_path, world), tmp_path / "out")
    truth = evaluation.read_groundtruth(out, body)
    np.testing.assert_allclose(truth.T_WC[:, 0, 3], np.arange(NUM))
    np.testing.assert_allclose(truth.poses[0], world[1])


def test_a_wrong_body_is_refused(tmp_path, bodies, world):
    """The free body, another kind, another gender, or none of this gender."""
    source, out = make_emdb(tmp_path / "P0", world), tmp_path / "out"
    man, lone = bodies / "SMPL_MALE.npz", tmp_path / "lone"
    lone.mkdir()
    other = tmp_path / "other"
    other.mkdir()
    (other / "SMPL_FEMALE.npz").symlink_to(bodies / "SMPL_FEMALE.npz")
    (lone / "SMPL_NEUTRAL.npz").symlink_to(bodies / "SMPL_NEUTRAL.npz")
    for model, message in (
        (None, "P0_09_walk_data.pkl: .*need SMPL, female, not the free body"),
        (man, r"need SMPL, female, not SMPL_MALE \(SMPL, male\)"),
        (bodies / "SMPL_NEUTRAL.npz", "not SMPL_NEUTRAL"),
        (bodies / "smplx", r"not SMPLX_FEMALE \(SMPL-X"),
        (lone, "No female body model found"),
    ):
        with pytest.raises(ValueError, match=message):
            evaluation.convert_emdb(source, out, model)
    root = make_rich(tmp_path / "rich", world)
    for model, message in (
        (None, "003.pkl: .*need SMPL-X, female, not the free body"),
        (other, r"need SMPL-X, female, not SMPL_FEMALE \(SMPL"),
    ):
        with pytest.raises(ValueError, match=message):
            evaluation.convert_rich(root, "val", RICH, 3, out, model)
    assert not out.exists() and not [*tmp_path.glob(".conversion-*")]


@pytest.mark.parametrize("place", ["named", "variable", "installed"])
def test_the_kind_needed_is_taken_out_of_a_folder_with_others(
    tmp_path, bodies, world, monkeypatch, place, caplog
):
    """smplx's own layout, `smpl/SMPL_MALE.npz` beside `smplx/SMPLX_MALE.npz`."""
    std = tmp_path / "share" / "bodyslam" / "body_models"
    (std / "smpl").mkdir(parents=True)
    for file in bodies.glob("*.npz"):
        (std / "smpl" / file.name).symlink_to(file)
    (std / "smplx").symlink_to(bodies / "smplx")
    if place == "variable":
        monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "nothing"))
        monkeypatch.setenv("BODYSLAM_BODY_MODEL", str(std))
    named = std if place == "named" else None
    smplx = bodies / "smplx" / "SMPLX_FEMALE.npz"
    T_CW, poses, trans, betas = world

    root = make_rich(tmp_path / "rich", world)
    out = evaluation.convert_rich(root, "val", RICH, 3, tmp_path / "out", named)
    still = poses * (np.arange(72) < 66), trans, betas
    found = evaluation.read_groundtruth(out, load_body_model(smplx)).joints[0]
    _expect_joints(found[:-1], smplx, (T_CW, still[0][:-1], trans[:-1], betas))
    source = make_emdb(tmp_path / "P0", world)
    out = evaluation.convert_emdb(source, tmp_path / "emdb", named)
    found = evaluation.read_groundtruth(out, load_body_model(smplx)).joints[0]
    _expect_joints(found, bodies / "SMPL_FEMALE.npz", world)

    # One ground truth with the same gender in both
    for h, width in enumerate((72, 165)):
        wide = np.pad(poses[:, :66], ((0, 0), (0, width - 66)))
        make_pair(tmp_path / str(h), world, gender="female", poses=wide)[1].rename(
            tmp_path / f"body_{h}.npz"
        )
    truth = read_truth(tmp_path, named)
    flat = T_CW, still[0], trans, betas
    _expect_joints(truth.joints[0], bodies / "SMPL_FEMALE.npz", flat)
    _expect_joints(truth.joints[1], smplx, flat)
    assert not caplog.records


def test_a_named_file_goes_before_a_better_name(tmp_path, bodies, world, monkeypatch):
    """As long as it fits."""
    home = tmp_path / "share" / "bodyslam" / "body_models"
    home.mkdir(parents=True)
    (home / "SMPL_FEMALE.npz").symlink_to(bodies / "SMPL_FEMALE.npz")
    (tmp_path / "own.npz").symlink_to(bodies / "SMPL_MALE.npz")
    monkeypatch.setenv("BODYSLAM_BODY_MODEL", str(tmp_path / "own.npz"))
    make_pair(tmp_path, world)[1].rename(tmp_path / "body.npz")
    _expect_joints(read_truth(tmp_path).joints[0], tmp_path / "own.npz", world)


def test_the_body_is_looked_for_where_it_always_is(
    tmp_path, bodies, world, monkeypatch
):
    source = make_emdb(tmp_path / "P0", world)
    monkeypatch.setenv("BODYSLAM_BODY_MODEL", str(bodies))
    assert evaluation.convert_emdb(source, tmp_path / "out").exists()
    monkeypatch.setenv("BODYSLAM_BODY_MODEL", str(bodies / "SMPL_MALE.npz"))
    with pytest.raises(ValueError, match="not SMPL_MALE"):
        evaluation.convert_emdb(source, tmp_path / "other")


def test_genders_of_rich(tmp_path, bodies, world):
    """By the toolkit's table, wherever it is; nobody's gender is made up."""
    root, out = make_rich(tmp_path / "data", world), tmp_path / "out"
    convert = lambda genders=None: evaluation.convert_rich(
        root, "val", RICH, 3, out, bodies / "smplx", genders
    )
    table = tmp_path / "table.json"
    (root / "resource" / "gender.json").rename(table)
    with pytest.raises(InputError, match="rich_toolkit.*--genders"):
        convert()
    assert convert(table) == out and _gender(out) == "female"
    for text, message in (
        ('{"4": "male"}', "subject 3: no entry"),
        ('{"3": "x"}', "subject 3: 'x', not female"),
        ("{", "not JSON"),
        ("[]", "a list, not a dictionary"),
    ):
        table.write_text(text)
        with pytest.raises(ValueError, match=f"table.json.*: {message}"):
            convert(table)


def test_bodies_without_joints_are_posed_by_gender(tmp_path, bodies, world, caplog):
    """A man and a woman in one truth, in text and in bytes as AMASS has both."""
    for h, gender in enumerate((np.array("female"), np.array(b"male"))):
        make_pair(tmp_path / str(h), world, gender=gender)[1].rename(
            tmp_path / f"body_{h}.npz"
        )
    truth = read_truth(tmp_path, bodies)
    for h, gender in enumerate(("FEMALE", "MALE")):
        _expect_joints(truth.joints[h], bodies / f"SMPL_{gender}.npz", world)
    assert not caplog.records
    read_truth(tmp_path, bodies / "SMPL_MALE.npz")
    (record,) = caplog.records
    assert "body_0.npz: no joints in it" in record.getMessage()
    caplog.clear()
    read_truth(tmp_path)
    assert len(caplog.records) == 2 and "the free body" in caplog.text
    with pytest.raises(InputError, match="nowhere: no such body model"):
        read_truth(tmp_path, tmp_path / "nowhere")


def test_where_to_register_is_said(tmp_path, bodies, world):
    trajectory, _ = make_pair(tmp_path / "pair", world)
    out = tmp_path / "out"
    convert = {
        "emdb.ait.ethz.ch": lambda: evaluation.convert_emdb(tmp_path / "P0", out),
        "virtualhumans.mpi-inf.mpg.de": lambda: evaluation.convert_3dpw(
            tmp_path / "a" / "b" / "c.pkl", out
        ),
        "rich.is.tue.mpg.de": lambda: evaluation.convert_rich(
            tmp_path, "val", RICH, 3, out
        ),
        "amass.is.tue.mpg.de": lambda: evaluation.convert_tum_amass(
            trajectory, tmp_path / "none.npz", out
        ),
    }
    for home, attempt in convert.items():
        with pytest.raises(InputError, match=home):
            attempt()
    assert not out.exists()


class _Evil:
    def __reduce__(self):
        return print, ("gotcha",)


def _with(name, part, value):
    return lambda data: data | {name: data[name] | {part: value}}


BAD_EMDB = {
    "malicious": (lambda data: _Evil(), "refused"),
    "list": (lambda data: [1, 2], "a list, not a dictionary"),
    "incomplete": (lambda data: {"n_frames": 3}, "no gender, good_frames_mask"),
    "no camera": (lambda data: data | {"camera": {}}, "no camera.intrinsics"),
    "smpl a list": (lambda data: data | {"smpl": [1]}, "smpl is a list, not a dict"),
    "gender": (lambda data: data | {"gender": "?"}, r"gender is '\?', not female"),
    "frames": (lambda data: data | {"n_frames": 0.5}, "n_frames: 0.5, not a whole"),
    "text": (lambda data: data | {"n_frames": "x"}, "n_frames: a str, not an array"),
    "shapes": (
        _with("smpl", "poses_root", np.ones((2, 3))),
        r"poses_root: \(2, 3\) values, not \(6, 3\)",
    ),
    "dictionary": (_with("smpl", "trans", {}), "trans: a dict, not an array"),
    "singular": (
        _with("camera", "extrinsics", np.zeros((NUM, 4, 4))),
        "camera.extrinsics: matrices that are no rigid motions",
    ),
}


@pytest.mark.parametrize("change, message", BAD_EMDB.values(), ids=BAD_EMDB)
def test_bad_files_of_emdb_are_refused(
    tmp_path, bodies, world, capsys, change, message
):
    dump(tmp_path / "P0_data.pkl", change(emdb_data(world)))
    with pytest.raises(ValueError, match=f"P0_data.pkl.*{message}"):
        evaluation.convert_emdb(tmp_path, tmp_path / "out", bodies)
    assert "gotcha" not in capsys.readouterr().out
    assert not (tmp_path / "out").exists()


BAD_3DPW = {
    "fewer": ({"trans": [np.zeros((NUM, 3))]}, "trans: 1 entries, not of 2 people"),
    "nobody": ({"poses": []}, "poses: 0 entries, not of at least one"),
    "prior_information": ({"sequence": "../walk"}, "sequence: '../walk', not the name"),
    "scalar": ({"poses": np.array(3)}, "poses: a ndarray, not a list"),
    "number": ({"poses": 3}, "poses: a int, not a list"),
    "lengths": ({"trans": [np.zeros((NUM, 3)), np.zeros((2, 3))]}, r"trans: \(2, 3\)"),
    "shape": ({"betas": [np.zeros(10), np.zeros(9)]}, r"betas: \(9,\) values"),
    "genders": ({"genders": ["m"]}, "genders: 1 entries"),
    "cameras": ({"cam_poses": None}, "cam_poses: "),
    "calibration": ({"cam_intrinsics": np.eye(2)}, r"cam_intrinsics: \(2, 2\)"),
    "detections": ({"poses2d": [np.zeros((NUM, 3, 18))]}, "poses2d: 1 entries"),
}


@pytest.mark.parametrize("change, message", BAD_3DPW.values(), ids=BAD_3DPW)
def test_bad_files_of_3dpw_are_refused(tmp_path, world, change, message):
    file = make_3dpw(tmp_path, threedpw_data(world) | change)
    with pytest.raises(ValueError, match=f"walk_00.pkl: {message}"):
        evaluation.convert_3dpw(file, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_bad_files_of_rich_are_refused(tmp_path, bodies, world):
    root, out = make_rich(tmp_path, world), tmp_path / "out"
    convert = lambda: evaluation.convert_rich(
        root, "val", RICH, 3, out, bodies / "smplx"
    )
    frames = root / "bodies" / "val" / RICH
    (frames / "00003").rename(frames / "first")
    with pytest.raises(ValueError, match="'first' does not begin with a number"):
        convert()
    dump(frames / "00004" / "003.pkl", {"betas": np.zeros(10)})
    (frames / "first").rename(frames / "00003")
    with pytest.raises(ValueError, match="003.pkl: no global_orient, body_pose"):
        convert()
    (root / "scan_calibration/Hall/calibration/003.xml").write_text("<a></a>")
    with pytest.raises(ValueError, match="003.xml: not a calibration"):
        convert()
    assert not out.exists()


def test_bad_motions_are_refused(tmp_path, world):
    trajectory, motion = make_pair(tmp_path, world)
    with np.load(motion) as good:
        arrays = {name: good[name] for name in good if name != "betas"}
    np.savez(tmp_path / "shapeless.npz", **arrays)
    (tmp_path / "text.npz").write_text("text")
    for name, message in (
        ("text", "text.npz: not a true body"),
        ("shapeless", "shapeless.npz: no array betas"),
    ):
        with pytest.raises(ValueError, match=message):
            evaluation.convert_tum_amass(
                trajectory, tmp_path / f"{name}.npz", tmp_path / "out"
            )
    with pytest.raises(InputError, match="no such folder of images"):
        evaluation.convert_tum_amass(
            trajectory, motion, tmp_path / "out", tmp_path / "images"
        )
    assert not (tmp_path / "out").exists()


def test_without_its_images_nothing_is_written(tmp_path, bodies, world):
    out = tmp_path / "out"
    dump(tmp_path / "P0" / "P0_data.pkl", emdb_data(world))
    emdb = lambda: evaluation.convert_emdb(tmp_path / "P0", out, bodies)
    file = dump(tmp_path / "a" / "b" / "walk_00.pkl", threedpw_data(world))
    threedpw = lambda: evaluation.convert_3dpw(file, out)
    for convert, images in (
        (emdb, tmp_path / "P0" / "images"),
        (threedpw, tmp_path / "imageFiles" / "walk_00"),
    ):
        with pytest.raises(InputError, match=f"{images}: no such folder"):
            convert()
        make_images(images, [])
        with pytest.raises(ValueError, match="no image in it"):
            convert()
        images.rmdir()
        make_images(images, ["00000.jpg"])
        with pytest.raises(ValueError, match="1 images, not one for 6 frames"):
            convert()
    assert not out.exists() and not [*tmp_path.glob(".conversion-*")]


def test_3dpw_from_within_its_own_folder(tmp_path, world, monkeypatch):
    file = make_3dpw(tmp_path, threedpw_data(world))
    monkeypatch.chdir(file.parent)
    out = evaluation.convert_3dpw(type(file)(file.name), tmp_path / "out")
    assert bs.read_sequence(out).num_frames == NUM


def test_a_conversion_replaces_only_itself(tmp_path, bodies, world):
    """What somebody put beside it stays, and no folder of theirs is written over."""
    source, out = make_emdb(tmp_path / "P0", world), tmp_path / "out"
    evaluation.convert_emdb(source, out, bodies)
    (out / "notes.txt").write_text("mine")
    with np.load(out / "groundtruth" / "body.npz") as old:
        poses = old["poses"]
    other = emdb_data(world) | {"camera": emdb_data(world)["camera"] | {"width": 60}}
    dump(source / "P0_09_walk_data.pkl", other)
    evaluation.convert_emdb(source, out, bodies)
    assert json.loads((out / "camera.json").read_text())["width"] == 60
    assert (out / "notes.txt").read_text() == "mine"
    with np.load(out / "groundtruth" / "body.npz") as new:
        np.testing.assert_array_equal(new["poses"], poses)
    with pytest.raises(ValueError, match="P0: has images, which no conversion wrote"):
        evaluation.convert_emdb(source, source, bodies)
    assert {file.name for file in source.iterdir()} == {"images", "P0_09_walk_data.pkl"}
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="file: a file; expected a folder"):
        evaluation.convert_emdb(source, tmp_path / "file", bodies)
