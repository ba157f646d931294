"""Validation of problems: errors are one line."""

import dataclasses
import functools
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
import scenes

import bodyslam_jax.graph as g
from bodyslam_jax.graph import validation
from bodyslam_jax.graph.padding import Masked
from bodyslam_jax.solver.padding import pad
from bodyslam_jax.solver.solve import method_of, run

T, L, M = 3, 6, 5
"""Frames, landmarks and observations; one person."""
FAR = 8
"""Landmarks that are seen all the time."""


def ones(*shape):
    return jnp.asarray(np.ones(shape))


def zeros(*shape):
    return jnp.asarray(np.zeros(shape))


def eye(n, *lead):
    return jnp.asarray(np.tile(np.eye(n), (*lead, 1, 1)))


@functools.cache
def fitting() -> tuple[g.State, dict[str, g.Factor]]:
    """A state and factors of each kind that has a check of its own; nothing is true."""
    state = g.State(
        scale=jnp.ones(()),
        cameras=eye(4, T),
        roots=eye(4, 1, T),
        poses=zeros(1, T, 23, 3),
        shapes=zeros(1, 10),
        landmarks=zeros(L, 3),
        intrinsics=jnp.array([600.0, 600, 320, 240]),
    )
    body = scenes.body_model()
    track = jnp.arange(M)
    factors = [
        g.Reprojection(track % T, track, zeros(M, 2), ones(M), g.Cauchy(1.5)),
        g.LandmarkPrior(zeros(L, 3), zeros(L, 3, 3)),
        g.KeypointReprojection(
            body, zeros(1, T, 25, 2), ones(1, T, 25), g.GemanMcClure(jnp.array(3.0))
        ),
        g.HumanMotion(zeros(1, T, 3), zeros(1, T, 3, 3), zeros(1, T), body=body),
        g.BodyPosePrior(zeros(1, T, 23, 3), ones(1, T, 23), zeros(1, T)),
        g.CameraPrior(eye(4, T), ones(T, 6)),
        g.IntrinsicsPrior(state.intrinsics[None], ones(1, 4)),
        g.AspectRatioPrior(ones(1)),
        g.RootOrientation(eye(3, 1, T), ones(1, T), zeros(1, T)),
        g.RootPositionPrior(ones(1, T, 3), ones(1, T, 2), zeros(1, T)),
        g.GroundContact(
            body,
            jnp.array([0.0, -1, 0]),
            1.5 * ones(1, T),
            ones(1, T),
            zeros(1, T),
        ),
    ]
    return state, {type(factor).__name__: factor for factor in factors}


def make(state=None, *, motion=None, free=None, **replaced):
    fits, factors = fitting()
    factors = list({**factors, **replaced}.values())
    return g.make_problem(factors, state or fits, motion=motion, free=free)


def changed(what, where, value):
    """One array of a state or a factor, exchanged where no constructor looks."""
    replace = value if callable(value) else lambda _: value
    return eqx.tree_at(lambda x: getattr(x, where), what, replace_fn=replace)


def test_valid_problems_are_accepted():
    problem = make()
    assert len(problem.factors) == len(fitting()[1])
    assert problem.variables == tuple(
        v for v in g.VARIABLES if v not in ("intrinsics", "globals")
    )


NAN = lambda x: x.at[(0,) * x.ndim].set(jnp.nan)
SHORT = lambda x: x[:, :-1]


@pytest.mark.parametrize(
    "where, value, message",
    [
        ("roots", SHORT, "roots: shape (1, 2, 4, 4), expected (1, 3, 4, 4)"),
        ("poses", SHORT, "poses: shape (1, 2, 23, 3), expected (1, 3, 23, 3)"),
        ("shapes", zeros(2, 10), "shapes: shape (2, 10), expected (1, 10)"),
        ("cameras", zeros(4, 4), "cameras: shape (4, 4), expected (t, 4, 4)"),
        ("cameras", lambda x: 2 * x, "cameras: 3 of 3 are no rigid poses"),
        ("cameras", NAN, "1 of 48 values are not finite"),
        ("roots", lambda x: x.at[0, 1, 0, 0].set(-1.0), "1 of 3 are no rigid poses"),
        ("roots", lambda x: x.at[0, 2, 3, 0].set(1.0), "the first at (0, 2)"),
        ("intrinsics", zeros(5), "5 numbers, expected 4 or 8"),
        ("scale", 1.0, "scale: found 1.0, expected an array"),
        ("landmarks", jnp.arange(18).reshape(6, 3), "int64, expected floating point"),
    ],
)
def test_an_invalid_state_is_refused(where, value, message):
    state, factors = fitting()
    with pytest.raises(ValueError) as refused:
        g.make_problem(list(factors.values()), changed(state, where, value))
    assert message in str(refused.value) and str(refused.value).startswith("state")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "name, where, value, message",
    [
        ("Reprojection", "pixel", NAN, "not finite"),
        ("Reprojection", "pixel", lambda x: x[:-1], "(4, 2), expected (5, 2)"),
        ("Reprojection", "pixel", zeros(M, 3), "(5, 3), expected (5, 2)"),
        ("Reprojection", "frame", lambda x: x.at[0].set(99), "0 to 2"),
        ("Reprojection", "frame", zeros(M), "float64, expected integers"),
        ("Reprojection", "landmark", lambda x: x.at[0].set(-1), "0 to 5"),
        ("Reprojection", "sigma", ones(1), "(1,), expected (5,)"),
        ("Reprojection", "sigma", lambda x: x.at[0].set(0.0), "above 0"),
        ("Reprojection", "loss", g.Cauchy(0.0), "loss.scale: found 0.0"),
        ("Reprojection", "loss", g.Cauchy(float("nan")), "not finite"),
        ("LandmarkPrior", "position", lambda x: x[:5], "(5, 3), expected (6, 3)"),
        ("LandmarkPrior", "whitening", ones(L, 3, 3), "1 landmarks have a prior"),
        ("KeypointReprojection", "pixel", NAN, "not finite"),
        ("KeypointReprojection", "pixel", zeros(1, T, 24, 2), "expected (1, 3, 25, 2)"),
        ("KeypointReprojection", "sigma", ones(1, T, 24), "expected (1, 3, 25)"),
        ("KeypointReprojection", "layout", "coco", "layout: found 'coco'"),
        (
            "KeypointReprojection",
            "bias",
            float("nan"),
            "bias: 1 of 1 values are not finite",
        ),
        ("HumanMotion", "translation", SHORT, "(1, 2, 3), expected (1, 3, 3)"),
        ("HumanMotion", "correlation", ones(1, T), "found 1.0, expected between"),
        (
            "BodyPosePrior",
            "correlation",
            1.5 * ones(1, T),
            "found 1.5, expected between",
        ),
        ("BodyPosePrior", "sigma", ones(1, 1, 23), "(1, 1, 23), expected (1, 3, 23)"),
        ("CameraPrior", "cameras", lambda x: 2 * x, "3 of 3 are no rigid poses"),
        ("IntrinsicsPrior", "intrinsics", zeros(1, 8), "(1, 8), expected (1, 4)"),
        ("AspectRatioPrior", "sigma", ones(T), "(3,), expected (1,)"),
        ("RootOrientation", "orientation", zeros(1, T, 3, 3), "no rigid rotations"),
        (
            "RootPositionPrior",
            "position",
            zeros(1, T, 3),
            "a depth of 0.0 m, expected above 0",
        ),
        ("GroundContact", "normal", ones(4), "(4,), expected (3,)"),
        ("GroundContact", "normal", lambda x: x / 1.5, "length 0.6667, expected 1"),
    ],
)
def test_measurements_that_do_not_fit_are_refused(name, where, value, message):
    factor = fitting()[1][name]
    if where == "layout":
        factor = dataclasses.replace(factor, **{where: value})
    else:
        factor = changed(factor, where, value)
    with pytest.raises(ValueError) as refused:
        make(**{name: factor})
    assert message in str(refused.value) and str(refused.value).startswith(name)
    assert "\n" not in str(refused.value)


def test_no_frames_are_refused():
    state, _ = fitting()
    none = dataclasses.replace(
        state,
        cameras=state.cameras[:0],
        roots=state.roots[:, :0],
        poses=state.poses[:, :0],
    )
    with pytest.raises(ValueError, match="0 frames, expected 1 or more"):
        g.make_problem([], none)


def test_shapes_of_presence_and_mask_are_checked():
    state, _ = fitting()
    people = g.MotionPredictor(lambda *_: None, None, None, jnp.ones((1, T + 1), bool))
    with pytest.raises(ValueError, match=r"motion.present: shape \(1, 4\)"):
        make(motion=people)
    free = changed(state.zero_step(), "cameras", ones(T, 4, 4))
    with pytest.raises(ValueError, match=r"free.cameras: shape \(3, 4, 4\)"):
        make(free=free)


def test_two_observations_in_one_frame_are_refused():
    factor = fitting()[1]["Reprojection"]
    twice = lambda x: jnp.concatenate([x, x[:1]]) if jnp.ndim(x) else x
    with pytest.raises(ValueError, match="observed twice"):
        make(Reprojection=jax.tree.map(twice, factor))


def test_priors_on_unobserved_landmarks_are_refused():
    state, factors = fitting()
    prior = changed(factors["LandmarkPrior"], "whitening", ones(L, 3, 3))
    with pytest.raises(ValueError, match="6 landmarks have a prior and no"):
        g.make_problem([prior], state)


def test_a_problem_too_large_for_memory_reports_how_many_frames_fit(monkeypatch):
    """And that many do."""

    def people_of(frames):
        rng = np.random.default_rng(0)
        return scenes.truth(rng, frames, 6, 0)

    monkeypatch.setattr(validation, "memory", lambda: 2**30)
    with pytest.raises(
        ValueError, match=r"need about \d\.\d GiB, found 1\.0 GiB"
    ) as error:
        g.make_problem([], people_of(400))
    (fit,) = re.findall(r"about (\d+) frames fit", str(error.value))
    assert 20 < int(fit) < 400
    g.make_problem([], people_of(int(0.9 * int(fit))))
    with pytest.raises(ValueError, match="frames fit"):
        g.make_problem([], people_of(int(1.2 * int(fit))))


@pytest.mark.slow
def test_memory_of_long_tracks_is_counted_in_every_chunk(monkeypatch):
    """As much more as the factorisation keeps for them, or some more."""

    def bytes_of(far):
        """What the factorisation keeps, and what is counted for those that go last."""
        longest = lambda span, *_: np.argsort(-span, kind="stable")[:far]
        monkeypatch.setattr("bodyslam_jax.graph.layout.choose_long_tracks", longest)
        monkeypatch.setattr("bodyslam_jax.graph.layout._GROUP_LANDMARKS", FAR)
        monkeypatch.setattr("bodyslam_jax.graph.layout.SIZES", ())
        problem, _, state = problems.make(frames=43, people=0, landmarks=60, far=far)
        assert problem.layout.lasting == far
        problem, state = pad(problem, state)
        method = method_of((), 0.0, state.scale.dtype, keep=True)
        final = jax.eval_shape(lambda: run(problem, state, method, alone=False)[1])
        kept = final.factor.side
        layout = problem.layout
        soon = tuple(dataclasses.replace(b, lasting=False) for b in layout.buckets)
        without = dataclasses.replace(layout, buckets=soon)
        counted, others = (
            validation.memory_needed(x, state, 69) for x in (layout, without)
        )
        return np.array([kept.size * kept.dtype.itemsize, counted - others])

    kept, counted = bytes_of(FAR) - bytes_of(0)
    assert 0 < kept <= counted <= 8 * kept


def test_memory_limits_of_containers_are_read(monkeypatch, tmp_path):
    limit, other = tmp_path / "memory.max", tmp_path / "none"
    limit.write_text("1048576\n")
    monkeypatch.setattr(validation, "_CGROUP_LIMIT_FILES", (str(other), str(limit)))
    assert validation.memory() == 2**20
    limit.write_text("max\n")
    assert validation.memory() > 2**28


def test_under_a_transformation_only_shapes_are_checked():
    state, factors = fitting()

    def residual(state, scale):
        seen = changed(factors["Reprojection"], "sigma", scale * ones(M))
        return g.make_problem([seen], state).factors[0].residual(state)

    found = jax.eval_shape(residual, state, jnp.zeros(()))
    assert found.shape == (M, 2)
    short = changed(state, "landmarks", zeros(L, 2))
    with pytest.raises(ValueError, match=r"shape \(6, 2\), expected \(6, 3\)"):
        jax.eval_shape(residual, short, jnp.ones(()))


def test_missing_measurements_may_be_zero_and_cost_nothing():
    state, factors = fitting()
    missing = {}
    for name in ("CameraPrior", "RootOrientation", "RootPositionPrior"):
        factor = changed(factors[name], factors[name].time_fields[0], jnp.zeros_like)
        never = lambda x: jnp.full_like(x, jnp.inf)
        missing[name] = changed(factor, "sigma", never)
    make(**missing)

    def cost(cameras, roots):
        moved = dataclasses.replace(state, cameras=cameras, roots=roots)
        return sum(factor.cost(moved) for factor in missing.values())

    slope = jax.value_and_grad(cost, (0, 1))
    value, slopes = jax.jit(slope)(state.cameras, state.roots)
    assert value == 0
    assert not slopes[0].any() and not slopes[1].any()


def test_a_video_too_long_to_order_reports_how_many_frames_fit(monkeypatch):
    """Tables over pairs of its chunks would not fit themselves."""

    def reached(*_):
        raise AssertionError("a dense table of chunks")

    monkeypatch.setattr("bodyslam_jax.graph.ordering._spectral", reached)
    monkeypatch.setattr(validation, "memory", lambda: 2**27)
    count = 10 * 3000
    landmark = np.repeat(np.arange(3000), 2)
    frame = 10 * landmark + np.tile([0, 5], 3000)
    state = scenes.truth(np.random.default_rng(0), 1, 0, 3000)
    state = dataclasses.replace(
        state,
        cameras=eye(4, count),
        roots=eye(4, 0, count),
        poses=zeros(0, count, 23, 3),
    )
    pixel = zeros(len(frame), 2)
    index = jnp.asarray(frame), jnp.asarray(landmark)
    track = g.Reprojection(*index, pixel, ones(len(frame)), g.Cauchy(1.5))
    with pytest.raises(ValueError, match=r"30000 frames need about .* frames fit"):
        g.make_problem([track], state)


@pytest.mark.parametrize(
    "loss, message",
    [
        (g.Squared, "loss: found <class"),
        (None, "loss: found None, expected a loss such as `Squared()`"),
        (
            changed(g.GemanMcClure(1.0), "scale", -1),
            "loss.scale: found -1, expected above 0",
        ),
        (changed(g.Cauchy(1.0), "scale", 0), "loss.scale: found 0, expected above 0"),
        (changed(g.Cauchy(1.0), "scale", "a"), "found 'a', expected a number"),
        (changed(g.Cauchy(1.0), "scale", float("inf")), "which is not finite"),
    ],
)
def test_invalid_losses_are_refused(loss, message):
    track = changed(fitting()[1]["Reprojection"], "loss", lambda _: loss)
    with pytest.raises(ValueError) as refused:
        make(Reprojection=track)
    assert message in str(refused.value) and "\n" not in str(refused.value)
    assert str(refused.value).startswith("Reprojection.loss")


def test_the_scale_of_a_loss_may_be_an_integer():
    track = changed(
        fitting()[1]["Reprojection"], "loss", changed(g.Cauchy(1.0), "scale", 2)
    )
    assert make(Reprojection=track).factors[0].loss.scale == 2


@pytest.mark.parametrize("value", [0.5, 2.0, -1.0, np.nan])
def test_a_coordinate_is_free_or_held(value):
    free = changed(
        fitting()[0].zero_step(), "roots", lambda x: x.at[0, 1, 2].set(value)
    )
    with pytest.raises(ValueError, match=f"free.roots: found {value}, expected 0 or 1"):
        make(free=free)


def test_a_mask_takes_the_precision_of_the_state():
    free = jax.tree.map(jnp.ones_like, fitting()[0].zero_step())
    free = jax.tree.map(lambda x: x.astype(jnp.float32), free)
    assert make(free=free).free.cameras.dtype == jnp.float64


EARLY = {
    "RootSmoothness": lambda: g.RootSmoothness(ones(1, T)),
    "AngularAccelerationPrior": lambda: g.AngularAccelerationPrior(ones(1, T)),
}


EARLY_FRAMES = [
    ("HumanMotion", "whitening", 0),
    ("HumanMotion", "correlation", 0),
    ("HumanMotion", "correlation", 1),
    ("BodyPosePrior", "correlation", 0),
    ("RootOrientation", "correlation", 0),
    ("RootPositionPrior", "correlation", 0),
    ("RootSmoothness", "sigma", 0),
    ("RootSmoothness", "sigma", 1),
    ("AngularAccelerationPrior", "sigma", 1),
]
"""Factors, their fields, and frames that have no earlier one to look back to."""


@pytest.mark.parametrize("name, field, at", EARLY_FRAMES)
def test_weights_of_frames_without_an_earlier_one_are_refused(name, field, at):
    """And let in one frame later."""
    factor = EARLY[name]() if name in EARLY else fitting()[1][name]
    first = max(a for n, f, a in EARLY_FRAMES if (n, f) == (name, field))
    empty = jnp.inf if field == "sigma" else 0.0
    none = lambda x: jnp.full_like(x, empty)
    one = lambda k: changed(factor, field, lambda x: none(x).at[:, k].set(0.5))
    with pytest.raises(ValueError, match=f"{name}.{field}: found 0.5 within frame"):
        make(**{name: one(at)})
    make(**{name: one(first + 1)})


@pytest.mark.parametrize(
    "name", ["RootOrientation", "RootPositionPrior", "HumanMotion"]
)
def test_correlation_with_a_missing_measurement_is_refused(name):
    factor = fitting()[1][name]
    where = "whitening" if name == "HumanMotion" else "sigma"
    measured = changed(factor, where, lambda x: jnp.ones_like(x).at[:, 0].set(0.0))
    if where == "sigma":
        measured = factor
    lasts = changed(measured, "correlation", lambda x: x.at[:, 2].set(0.5))
    make(**{name: lasts})
    nothing = 0.0 if where == "whitening" else jnp.inf
    lost = changed(lasts, where, lambda x: x.at[:, 1].set(nothing))
    message = f"{name}.correlation: found 0.5 in frame 2 of person 0, expected 0.0"
    with pytest.raises(ValueError, match=message):
        make(**{name: lost})
    # Nor does it matter where this one is not measured, either.
    make(**{name: changed(lost, where, lambda x: x.at[:, 2].set(nothing))})


def test_a_state_has_one_precision():
    state, factors = fitting()
    mixed = changed(state, "landmarks", lambda x: x.astype(jnp.float32))
    with pytest.raises(ValueError, match="state.landmarks: found float32, expected f"):
        make(mixed)
    single = jax.tree.map(lambda x: x.astype(jnp.float32), state)
    with pytest.raises(ValueError, match="pixel: found float64, expected float32 as"):
        g.make_problem([factors["Reprojection"]], single)
    half = jax.tree.map(lambda x: x.astype(jnp.float16), state)
    with pytest.raises(ValueError, match="found float16, expected float32 or float64"):
        make(half)


@pytest.mark.slow
def test_added_frames_have_no_weight_in_any_factor():
    """Wherever the frames are: they stay where they were as others move."""
    state, factors = fitting()
    longer = g.extend_state(state, 2)
    longer = dataclasses.replace(longer, cameras=longer.cameras.at[T:, 0, 3].add(0.3))
    checked = 0
    for name, factor in factors.items():
        if isinstance(factor, g.FrameFactor):
            padded = g.pad_factor(factor, state, 2)
            assert not isinstance(padded, Masked), name
            found, expected = padded.cost(longer), factor.cost(state)
            np.testing.assert_allclose(found, expected, rtol=1e-12, err_msg=name)
            checked += 1
    assert checked >= 9


@pytest.mark.slow
def test_a_loss_has_one_scale_or_one_for_each_keypoint():
    state, factors = fitting()
    keypoints = factors["KeypointReprojection"]
    assert isinstance(keypoints, g.KeypointReprojection)
    each = dataclasses.replace(keypoints, loss=g.GemanMcClure(3.0 * ones(1, T, 25)))
    one = dataclasses.replace(keypoints, loss=g.GemanMcClure(3.0))
    moved = dataclasses.replace(state, roots=state.roots.at[..., 2, 3].set(4.0))
    make(KeypointReprojection=each)
    np.testing.assert_allclose(each.cost(moved), one.cost(moved), rtol=1e-12)
    for a, b in zip(each.curvature(moved), one.curvature(moved), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)
    padded = g.pad_factor(each, moved, 2)
    longer = g.extend_state(moved, 2)
    np.testing.assert_allclose(padded.cost(longer), one.cost(moved), rtol=1e-12)
    wrong = dataclasses.replace(keypoints, loss=g.GemanMcClure(ones(25)))
    with pytest.raises(
        ValueError, match=r"scale: shape \(25,\), expected one number, "
    ):
        make(KeypointReprojection=wrong)


def test_tracks_may_be_added_to_a_problem_that_has_none():
    whole, _, state = problems.make()
    sigma = jnp.ones((len(state.cameras), 6))
    first = g.CameraPrior(cameras=state.cameras, sigma=sigma)
    found = g.make_problem([first], state).with_factors(*whole.factors)
    both = g.make_problem([first, *whole.factors], state)
    assert float(found.cost(state)) == float(both.cost(state))
    assert len(found.layout.buckets) == len(both.layout.buckets) > 0
