"""Estimates the floor from people's feet alone, for a camera that does not move.

Such a camera has no map, and each person's distance follows from their size alone, so
that people whose sizes have different errors would stand on floors of different
heights. Here they stand on one plane: its normal comes from `ground.gravity`, and its
distance from the camera, `s d` with constant d, is estimated with people's sizes. The
variable s, metres per unit of the map, is free for this, as the map has no other
length.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from bodyslam_jax import body as body_
from bodyslam_jax import graph, initialisation
from bodyslam_jax.body import BodyModel
from bodyslam_jax.body.skeleton import FEET
from bodyslam_jax.config import GraphWeights
from bodyslam_jax.ground.gravity import Upright, level
from bodyslam_jax.ground.stances import toes_standing
from bodyslam_jax.ground.vertical_edges import Edges
from bodyslam_jax.types import Keypoints

_MIN_CONTACT_PROBABILITY = 0.5
"""Contact probability of a foot above which it counts as standing."""
_RELATIVE_SIZE_SIGMA = 0.055
"""Relative standard deviation of a person's size, and thus of the height of the camera
over the feet."""
_FOOT_SIGMA_M, _TILT_SIGMA_RAD = 0.04, 0.05
"""Standard deviations of the height of a foot, m, from errors of posture, and of the
slope of the floor, rad."""
_MIN_STANDING_FRAMES = 10
"""Least number of frames with standing feet of a person on the floor."""
_MIN_CAMERA_HEIGHT_M = 0.1
"""Least height of the camera over feet at which the floor determines distances, m."""
_MAX_FLOOR_SIGMAS = 2.5
"""Difference in height, in standard deviations, above which a person stands on another
floor than the others."""


@dataclasses.dataclass(frozen=True)
class View:
    """Measurements of people and camera that are not part of the state."""

    present: Bool[np.ndarray, "h t"]
    keypoints: Keypoints | None
    fitted: Bool[np.ndarray, " h"]
    fps: float
    gravity: tuple[float, ...]
    edges: Edges | None = None
    """Straight edges in the images, in the world of the cameras."""


def without_floor(
    body: BodyModel, present: Bool[np.ndarray, "h t"]
) -> graph.GroundContact:
    """Returns a ground contact factor without weight, which `on_floor` replaces."""
    return graph.GroundContact(
        body,
        jnp.array([0.0, -1.0, 0.0]),
        jnp.ones(present.shape),
        jnp.full(present.shape, jnp.inf),
        jnp.zeros(present.shape),
    )


def on_floor(
    state: graph.State,
    probability: Float[Array | np.ndarray, "h t 4"] | None,
    view: View,
    body: BodyModel,
    weights: GraphWeights,
) -> graph.GroundContact:
    """Returns the factor of people who stand on one floor, without weight if too few
    do.

    `probability` is the contact probability of toes and heels; without it, feet stand
    by their speed. People who stand higher or lower than the others, by more than
    errors of their size explain, are not on the floor.
    """
    present = initialisation.with_visible_feet(view.present, view.keypoints)
    none = without_floor(body, present)
    assert weights.ground_sigma is not None
    stands = present
    if probability is not None:
        stands = present & (
            np.asarray(probability).max(axis=-1) > _MIN_CONTACT_PROBABILITY
        )
    if not (stands.sum(axis=1) >= _MIN_STANDING_FRAMES).any():
        return none
    normal = _upright(state, probability, view, body).normal
    bare = eqx.tree_at(
        lambda f: (f.normal, f.offset, f.sigma),
        none,
        (jnp.asarray(normal), jnp.zeros(present.shape), jnp.ones(present.shape)),
    )
    height = np.asarray(graph.residual_of(bare, state))[..., 0]
    places = np.asarray(state.cameras @ state.roots)[..., :3, 3]
    level, on = common_height(
        height, places @ (np.eye(3) - np.outer(normal, normal)), stands
    )
    used = stands & on[:, None]
    count = used.sum(axis=1, keepdims=True)
    # The prior of a fitted shape has a smaller σ than its uncertainty, to balance
    # keypoints with correlated errors; other measurements of size are scaled by the
    # same factor.
    own = weights.ground_sigma * np.where(view.fitted, weights.shape_sigma, 1.0)
    sigma = np.where(used, own[:, None] * np.sqrt(count), np.inf)
    if not used.any() or level > -_MIN_CAMERA_HEIGHT_M:
        return none
    return eqx.tree_at(
        lambda f: (f.offset, f.sigma),
        bare,
        (jnp.full(present.shape, -level), jnp.asarray(sigma)),
    )


def people_on_floor(problem: graph.Problem) -> Bool[np.ndarray, " h"] | None:
    """Returns which people stand on the floor; `None` if nobody does."""
    for factor in problem.factors:
        if isinstance(factor, graph.GroundContact):
            on = np.array([np.isfinite(sigma).any() for sigma in factor.sigma])
            return on if on.any() else None
    return None


def common_height(
    height: Float[np.ndarray, "h t"],
    places: Float[np.ndarray, "h t 3"],
    used: Bool[np.ndarray, "h t"],
) -> tuple[float, Bool[np.ndarray, " h"]]:
    """Returns the height of the floor over the camera, m, and which people stand on it.

    `height` is the height of the lower foot over the camera, m, `places` are people's
    positions in the plane, m. Of the floors that each person defines, the one that
    agrees with most frames is chosen.
    """
    count = used.sum(axis=1)
    some = np.flatnonzero(count >= _MIN_STANDING_FRAMES)
    on = np.zeros(len(height), bool)
    if not len(some):
        return 0.0, on
    own = np.array([np.median(height[h, used[h]]) for h in some])
    sigma = np.hypot(_FOOT_SIGMA_M, _RELATIVE_SIZE_SIGMA * own)
    middle = np.array([np.median(places[h, used[h]], axis=0) for h in some])
    way = np.linalg.norm(middle[:, None] - middle, axis=-1)
    error = np.hypot(np.hypot(sigma[:, None], sigma), _TILT_SIGMA_RAD * way)
    agree = np.abs(own[:, None] - own) < _MAX_FLOOR_SIGMAS * error
    chosen = agree[np.argmax(agree @ count[some])]
    on[some[chosen]] = True
    weight = sigma[chosen] ** -2.0
    return float(weight @ own[chosen] / weight.sum()), on


def _upright(
    state: graph.State,
    probability: Float[Array | np.ndarray, "h t 4"] | None,
    view: View,
    body: BodyModel,
) -> Upright:
    """Estimates the up direction from people and edges at `state`, without a map."""
    cameras = np.asarray(state.cameras)
    roots = cameras @ np.asarray(state.roots)
    joints = np.asarray(_local_joints(body, state.poses, state.shapes[:, None]))
    feet = joints[..., list(FEET), :] @ np.swapaxes(roots[..., :3, :3], -1, -2)
    feet = feet + roots[..., None, :3, 3]
    standing = toes_standing(None if probability is None else np.asarray(probability))
    return level(
        cameras,
        roots[..., :3, 1],
        feet,
        view.present,
        np.zeros((0, 3)),
        view.fps,
        view.fitted,
        view.gravity,
        standing,
        view.edges,
    )[1]


_local_joints = eqx.filter_jit(body_.local_joints)
