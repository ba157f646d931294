"""Settings that mean nothing are refused where they are made."""

import dataclasses
import pickle

import jax.numpy as jnp
import pytest

from bodyslam_jax.cli.settings import read_settings
from bodyslam_jax.config import (
    Association,
    Config,
    Detect,
    GraphWeights,
    PeopleFit,
    Structure,
    Tracking,
)
from bodyslam_jax.config.errors import InputError

NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("kind", "name", "value", "expected"),
    [
        (
            Config,
            "solver",
            "foo",
            "one of ['structured', 'adam', 'optimistix_lm', 'jaxopt_lm']",
        ),
        (Config, "smoothing_hz", 0.0, "more than 0, and finite, or nothing"),
        (Config, "smoothing_hz", -3.0, "more than 0, and finite, or nothing"),
        (Config, "overlay", 1, "true or false"),
        (Config, "body_model", 3, "a text, or nothing"),
        (Tracking, "num_points", 0, "1 or more"),
        (Tracking, "num_points", 8.0, "a whole number"),
        (Tracking, "num_points", True, "a whole number"),
        (Structure, "landmark_span", 1, "2 or more"),
        (Structure, "focal_runs", NAN, "more than 0, and finite"),
        (Detect, "min_height", -0.1, "0 or more"),
        (Association, "max_gap", INF, "0 or more, and finite"),
        (PeopleFit, "regressor_shape_gain", 0.0, "more than 0, and finite, or nothing"),
        (GraphWeights, "keypoint_sigma", "abc", "a number, or nothing"),
        (GraphWeights, "landmark_loss", None, "a number"),
        (GraphWeights, "posture_correlation", 1.0, "0 to 0.999999"),
        (GraphWeights, "step_error", -0.1, "0 or more"),
        (GraphWeights, "posture_correlation", INF, "0 to 0.999999"),
        (GraphWeights, "keypoint_loss", INF, "more than 0, and finite"),
        (GraphWeights, "shape_each_frame", INF, "true or false"),
    ],
)
def test_settings_that_mean_nothing_are_refused(kind, name, value, expected):
    # As made without the types that tests check everywhere.
    settings = kind()
    object.__setattr__(settings, name, value)
    with pytest.raises(ValueError) as refused:
        settings.__post_init__()
    assert str(refused.value) == f"{name}: found {value!r}, expected {expected}."


def test_settings_that_mean_something_are_let_in():
    Config()
    Config.paper()
    Detect(min_height=0.0)
    GraphWeights(step_error=0.0, motion_correlation=0.0)
    weights = GraphWeights()
    # What says nothing; what is mapped over may not be known yet.
    for value in (1, INF, jnp.ones(3)):
        object.__setattr__(weights, "posture_sigma", value)
        weights.__post_init__()
    dataclasses.replace(Config(), smoothing_hz=None)
    PeopleFit(limit_sigma=INF)
    Structure(focal_accuracy=INF)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("tracking: {cells: 8}", "tracking: no setting `cells`; expected one of"),
        ("wieghts: {}", "no setting `wieghts`; did you mean `weights`?"),
        (
            "people_fit: {walking_knees: true}",
            "people_fit: `walking_knees` no longer exists: knees are as measured.",
        ),
        (
            "weights: {upright_sigma: 0.1}",
            "weights: `upright_sigma` no longer exists: it changed nothing",
        ),
        ("smoothing_hz: 0.0", "smoothing_hz: found 0.0, expected more than 0"),
        (
            "tracking: {num_points: 0}",
            "tracking: num_points: found 0, expected 1 or more",
        ),
    ],
)
def test_a_file_of_settings_is_named_with_what_is_wrong_in_it(tmp_path, text, expected):
    path = tmp_path / "config.yaml"
    path.write_text(text)
    with pytest.raises(ValueError) as refused:
        read_settings(path, Config())
    assert str(refused.value).startswith(f"{path}: {expected}")
    assert str(refused.value).count(str(path)) == 1


def test_a_message_about_an_input_is_a_line_that_a_terminal_can_show():
    error = InputError("a.json: found 'x\ny\x1b[2J\u2028\udcff\0'.")
    assert str(error) == r"a.json: found 'x\ny\x1b[2J\u2028\udcff\x00'."
    assert len(str(InputError("a" * 10**6))) < 2000
    several = InputError("first.", "sec\nond.")
    assert several.lines == ["first.", r"sec\nond."]
    assert str(several) == r"first. sec\nond."
    assert str(pickle.loads(pickle.dumps(several))) == str(several)
