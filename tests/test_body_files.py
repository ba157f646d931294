import os
import pickle
import sys
import types

import jax.numpy as jnp
import numpy as np
import pytest
from body_cases import make_raw, smpl, write
from hypothesis import given, settings
from hypothesis import strategies as st

from bodyslam_jax import body


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("files")


def refusal(path, **options):
    """The message with which a file is refused; it is one line and names the file."""
    with pytest.raises(ValueError) as caught:
        body.load_body_model(path, **options)
    message = str(caught.value)
    assert "\n" not in message and str(path) in message
    return message


def one_body(num_joints=24, seed=0):
    rng = np.random.default_rng(seed)
    pose = 0.7 * rng.normal(size=72)
    return pose, rng.normal(size=10), rng.normal(size=3)


def library(name, **classes):
    """A module that pretends to be the library whose objects are pickled."""
    module = types.ModuleType(name)
    for key, cls in classes.items():
        cls.__module__, cls.__qualname__, cls.__name__ = name, key, key
        setattr(module, key, cls)
    return module


@pytest.fixture
def original_pickle(tmp_path, monkeypatch):
    """SMPL's own form: Python 2's protocol, chumpy and scipy.sparse objects."""
    from scipy.sparse import csc_matrix

    raw = make_raw(seed=3)
    Ch, Select = type("Ch", (), {}), type("Select", (), {})
    Csc = type("csc_matrix", (), {})
    for name, module in (
        ("chumpy", library("chumpy")),
        ("chumpy.ch", library("chumpy.ch", Ch=Ch)),
        ("chumpy.reordering", library("chumpy.reordering", Select=Select)),
        ("scipy.sparse.csc", library("scipy.sparse.csc", csc_matrix=Csc)),
    ):
        monkeypatch.setitem(sys.modules, name, module)
    shape_dirs, template, sparse = Ch(), Select(), Csc()
    shape_dirs.__dict__.update(x=raw["shapedirs"], dterms=("x",))
    inner = Ch()
    inner.__dict__.update(x=raw["v_template"][:, ::-1])
    index = np.arange(raw["v_template"].size).reshape(-1, 3)[:, ::-1]
    template.__dict__.update(a=inner, idxs=index.ravel(), preferred_shape=(70, 3))
    csc = csc_matrix(raw["J_regressor"])
    sparse.__dict__.update(
        data=csc.data, indices=csc.indices, indptr=csc.indptr, _shape=csc.shape
    )
    content = dict(raw, shapedirs=shape_dirs, v_template=template, J_regressor=sparse)
    content["bs_style"] = "lbs"
    path = tmp_path / "basicmodel_neutral_lbs_10_207_0_v1.1.0.pkl"
    path.write_bytes(pickle.dumps(content, protocol=2))
    for name in ("chumpy", "chumpy.ch", "chumpy.reordering", "scipy.sparse.csc"):
        monkeypatch.delitem(sys.modules, name)
    return path, raw


def test_reads_the_original_pickle(original_pickle):
    path, raw = original_pickle
    before = set(sys.modules)
    for place in (path, path.parent):
        model = body.load_body_model(place, dtype="float64")
        np.testing.assert_array_equal(model.template, raw["v_template"])
        np.testing.assert_array_equal(model.shape_dirs, raw["shapedirs"])
        np.testing.assert_allclose(model.joint_regressor, raw["J_regressor"])
    assert not {n for n in set(sys.modules) - before if n.startswith(("chumpy", "sci"))}
    assert "SMPL, 70 vertices" in body.check(path)


class _Malicious:
    def __init__(self, command, argument):
        self.call = (command, (argument,))

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("protocol", [0, 2, 4])
@pytest.mark.parametrize("command", [os.system, eval, exec, __import__, np.load])
def test_refuses_a_malicious_pickle_before_it_runs(tmp_path, command, protocol):
    flag = tmp_path / "ran"
    argument = f"open({str(flag)!r}, 'w').write('x')"
    if command is os.system:
        argument = f"touch {flag}"
    content = dict(make_raw(), evil=_Malicious(command, argument))
    path = tmp_path / "SMPL_NEUTRAL.pkl"
    path.write_bytes(pickle.dumps(content, protocol))
    assert "refused" in refusal(path)
    assert not flag.exists()


def test_refuses_attributes_reached_through_an_allowed_name(tmp_path):
    # Protocol 4 looks up dotted names: numpy.ndarray.tofile would write a file.
    path = tmp_path / "dotted.pkl"
    path.write_bytes(b"\x80\x04\x8c\x05numpy\x94\x8c\x0endarray.tofile\x93.")
    assert "refused" in refusal(path)


@pytest.mark.parametrize("num_joints", [52, 55])
def test_hands_and_face_follow_wrists_and_head(folder, num_joints):
    raw = make_raw(num_joints=num_joints)
    model = body.load_body_model(write(raw, folder / f"{num_joints}.npz"))
    pose, beta, trans = one_body()
    J, V = smpl(raw, pose[:66], beta, trans)
    found = body.joints(model, *map(jnp.asarray, (pose, beta, trans)))
    np.testing.assert_allclose(found[:22], J[:22], atol=1e-12)
    first = num_joints - 30
    np.testing.assert_allclose(found[22:], J[[first + 3, first + 18]], atol=1e-12)
    found = body.vertices(model, *map(jnp.asarray, (pose, beta, trans)))
    np.testing.assert_allclose(found, V, atol=1e-12)
    assert model.kind == {52: "smplh", 55: "smplx"}[num_joints]


@pytest.mark.parametrize("num_joints", [24, 55])
def test_written_files_read_the_same(folder, num_joints):
    model = body.load_body_model(
        write(make_raw(num_joints=num_joints), folder / f"in{num_joints}.npz")
    )
    out = folder / f"out{num_joints}.npz"
    body.write_npz(model, out)
    again = body.load_body_model(out)
    args = tuple(map(jnp.asarray, one_body()))
    for function in (body.joints, body.vertices, body.keypoints):
        np.testing.assert_allclose(
            function(again, *args), function(model, *args), atol=1e-12
        )
    assert not list(folder.glob("*.part"))
    with np.load(out) as archive:
        assert archive["kintree_table"].shape == (2, 24)
        assert archive["posedirs"].shape == (70, 3, 207)


def test_an_object_beside_the_arrays_does_no_harm(folder):
    # SMPL-X has such; they are skipped, not unpickled.
    raw = dict(make_raw(), part2num=np.array({"head": 1}, dtype=object))
    assert "SMPL" in body.check(write(raw, folder / "objects.npz"))


def test_search_order_and_its_error(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.delenv("BODYSLAM_BODY_MODEL", raising=False)
    assert body.load_body_model().kind == "default"
    with pytest.raises(ValueError) as caught:
        body.load_body_model(gender="male")
    home = tmp_path / "data" / "bodyslam" / "body_models"
    assert f"{home} (SMPL_MALE.npz, SMPL_MALE.pkl, ...)" in str(caught.value)
    assert body.search_paths("male")[:2] == [
        home / f"SMPL_MALE.{x}" for x in ("npz", "pkl")
    ]
    home.mkdir(parents=True)
    write(make_raw(seed=1), home / "SMPL_MALE.npz")
    assert body.load_body_model(gender="male").name == "SMPL_MALE"
    named = write(make_raw(seed=2), tmp_path / "mine.npz")
    monkeypatch.setenv("BODYSLAM_BODY_MODEL", str(named))
    assert body.load_body_model(gender="male").name == "mine"
    monkeypatch.setenv("BODYSLAM_BODY_MODEL", str(tmp_path / "nothing"))
    with pytest.raises(ValueError, match="BODYSLAM_BODY_MODEL is set"):
        body.load_body_model()
    with pytest.raises(ValueError, match="expected neutral, female or male"):
        body.load_body_model(gender="other")


def edit(name, change):
    def edited(raw):
        raw[name] = change(raw[name].copy())

    return edited


def put(index, value):
    def changed(array):
        array[index] = value
        return array

    return changed


BAD = {
    "no array `f`": (lambda raw: raw.pop("f"), "no f"),
    "NaN": (edit("shapedirs", put((3, 1, 2), np.nan)), "NaN"),
    "infinite": (edit("v_template", put((0, 0), np.inf)), "NaN or infinite"),
    "flat": (edit("v_template", np.ravel), "shape (210,)"),
    "four axes": (edit("v_template", lambda x: np.tile(x, 2)[:, :4]), "(v, 3)"),
    "centimetres": (edit("v_template", lambda x: 100 * x), "m tall"),
    "three shapes": (edit("shapedirs", lambda x: x[:, :, :3]), "at least 10"),
    "other mesh": (edit("shapedirs", lambda x: x[:-1]), "(70, 3, at least 10)"),
    "half posedirs": (edit("posedirs", lambda x: x[:, :, :100]), "(70, 3, 207)"),
    "joints": (edit("weights", lambda x: x[:, :20]), "20 joints"),
    "weights": (edit("weights", lambda x: 2 * x), "sum to 1"),
    "negative": (
        edit("weights", lambda x: x + np.eye(70, 24) - np.roll(np.eye(70, 24), 1, 1)),
        "negative",
    ),
    "regressor": (edit("J_regressor", np.transpose), "(24, 70)"),
    "text": (edit("weights", lambda x: x.astype(str)), "real numbers"),
    "far vertex": (edit("f", put((0, 0), 70)), "vertex 70"),
    "quads": (edit("f", lambda x: np.tile(x, 2)[:, :4]), "(faces, 3)"),
    "fractions": (edit("f", lambda x: x + 0.5), "whole numbers"),
    "cycle": (edit("kintree_table", put((0, 4), 10)), "cycle"),
    "self": (edit("kintree_table", put((0, 7), 7)), "cycle"),
    "other tree": (edit("kintree_table", put((0, 13), 12)), "not SMPL's tree"),
    "short tree": (edit("kintree_table", lambda x: x[:, :9]), "(2, 24)"),
    "no tree": (edit("kintree_table", lambda x: x[:0]), "(2, 24)"),
    "scalar": (edit("J_regressor", lambda x: np.float64(1.0)), "J_regressor"),
}


@pytest.mark.parametrize("suffix", [".npz", ".pkl"])
@pytest.mark.parametrize("case", BAD)
def test_bad_arrays(folder, case, suffix):
    change, expected = BAD[case]
    raw = make_raw()
    change(raw)
    path = folder / f"bad{suffix}"
    if suffix == ".npz":
        write(raw, path)
    else:
        path.write_bytes(pickle.dumps(raw, protocol=2))
    assert expected in refusal(path)
    with pytest.raises(ValueError):
        body.check(path)


@pytest.mark.parametrize("text", ["", "hello, world\n", "version https://git-lfs\n"])
@pytest.mark.parametrize("name", ["text.pkl", "text.npz"])
def test_text_is_not_a_body(folder, name, text):
    path = folder / name
    path.write_text(text)
    assert "not a" in refusal(path)


@pytest.fixture(scope="module")
def whole_files(folder):
    raw = make_raw(num_vertices=8, pose_dirs=False)
    npz = write(raw, folder / "whole.npz").read_bytes()
    return {".npz": npz, ".pkl": pickle.dumps(raw, protocol=2)}


@given(st.sampled_from([".npz", ".pkl"]), st.floats(0, 0.999))
@settings(max_examples=60, deadline=None)
def test_files_cut_short(folder, whole_files, suffix, share):
    whole = whole_files[suffix]
    path = folder / f"cut{suffix}"
    path.write_bytes(whole[: int(share * len(whole))])
    refusal(path)


@given(
    st.sampled_from([".npz", ".pkl"]),
    st.lists(st.tuples(st.floats(0, 0.999), st.integers(0, 255)), max_size=8),
)
@settings(max_examples=100, deadline=None)
def test_damaged_bytes_load_or_are_refused(folder, whole_files, suffix, damage):
    whole = bytearray(whole_files[suffix])
    for where, value in damage:
        whole[int(where * len(whole))] = value
    path = folder / f"damaged{suffix}"
    path.write_bytes(whole)
    try:
        model = body.load_body_model(path)
    except ValueError as error:
        assert "\n" not in str(error)
    else:
        assert np.isfinite(model.template).all()


@given(st.binary(max_size=200))
@settings(max_examples=60, deadline=None)
def test_noise_is_refused(folder, noise):
    path = folder / "noise.pkl"
    path.write_bytes(noise)
    refusal(path)


@pytest.mark.parametrize(
    "name",
    ["SMPL_FEMALE.npz", "basicModel_f_lbs_10_207_0_v1.0.0.pkl", "female/model.npz"],
)
def test_a_gender_asked_for_is_not_that_of_another_file(tmp_path, monkeypatch, name):
    monkeypatch.delenv("BODYSLAM_BODY_MODEL", raising=False)
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(write(make_raw(), tmp_path / "any.npz").read_bytes())
    assert "a female body, expected male" in refusal(path, gender="male")
    monkeypatch.setenv("BODYSLAM_BODY_MODEL", str(path))
    for gender in ("male", "neutral"):
        with pytest.raises(ValueError, match=f"a female body, expected {gender}"):
            body.load_body_model(gender=gender)
    for gender in ("female", None):
        assert body.load_body_model(gender=gender).name == path.stem
    assert "SMPL, 70 vertices" in body.check(tmp_path, "female")


@pytest.mark.parametrize("name", ["none/out.npz", "text/out.npz", "folder.npz"])
def test_a_file_that_cannot_be_written_is_named(tmp_path, name):
    model = body.load_body_model(write(make_raw(), tmp_path / "in.npz"))
    (tmp_path / "text").write_text("no folder")
    (tmp_path / "folder.npz").mkdir()
    before = sorted(tmp_path.iterdir())
    with pytest.raises(OSError) as caught:
        body.write_npz(model, tmp_path / name)
    assert caught.value.filename == str(tmp_path / name) and caught.value.strerror
    assert sorted(tmp_path.iterdir()) == before


def test_other_suffixes_are_refused(tmp_path):
    model = body.load_body_model(write(make_raw(), tmp_path / "in.npz"))
    for write_to, name in (
        (body.write_npz, "out.pkl"),
        (body.save_picture, "picture.foo"),
        (body.save_picture, "picture"),
    ):
        with pytest.raises(ValueError, match=f"{name}: suffix .*, expected"):
            write_to(model, tmp_path / name)
        assert not (tmp_path / name).exists()
