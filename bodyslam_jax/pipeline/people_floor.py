"""The floor before a camera that does not move: people's feet alone determine it.

Such a camera has no map, and each person's distance follows from their size alone, so
that people whose sizes err differently would stand on floors of different heights. They
stand on one plane here: its normal is that of `geometry.gravity`, and its distance from
the camera, `s d` with d constant, is estimated with people's sizes: s, the metres per
unit of the map, is free for want of another length in the map.
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
from bodyslam_jax.geometry.gravity import Upright
from bodyslam_jax.geometry.levelling import level
from bodyslam_jax.geometry.stances import toes_standing
from bodyslam_jax.geometry.vertical_edges import Edges
from bodyslam_jax.types import Keypoints

_STANDS = 0.5
"""Probability of a foot to stand from which the frame counts."""
_SIZE = 0.055
"""Relative standard deviation of a person's size, and so of the height of the camera
over the feet."""
_FOOT, _TILT = 0.04, 0.05
"""Standard deviations of a foot's height in a posture, m, and of the floor's slope,
rad."""
_FEWEST = 10
"""Frames with standing feet, for a person to be on the floor."""
_LOWEST_CAMERA = 0.1
"""Height of the camera over the feet from which the floor tells distances, m."""
_OFF = 2.5
"""Standard deviations from the others by which somebody stands on another floor."""


@dataclasses.dataclass(frozen=True)
class View:
    """What is known of people and camera beside the state."""

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
    """The factor of ground contact without weight: `on_floor` takes its place."""
    return graph.GroundContact(
        body,
        jnp.array([0.0, -1.0, 0.0]),
        jnp.ones(present.shape),
        jnp.full(present.shape, jnp.inf),
    )


def on_floor(
    state: graph.State,
    probability: Float[Array | np.ndarray, "h t 4"] | None,
    view: View,
    body: BodyModel,
    weights: GraphWeights,
) -> graph.GroundContact:
    """The factor of people who stand on one floor; without weight where too few do.

    `probability` is that of toes and heels to stand; without it feet stand by their
    speed. Whoever stands higher or lower than the others by more than errors of sizes
    explain is on no floor.
    """
    present = initialisation.with_visible_feet(view.present, view.keypoints)
    none = without_floor(body, present)
    assert weights.ground_sigma is not None
    stands = present
    if probability is not None:
        stands = present & (np.asarray(probability).max(axis=-1) > _STANDS)
    if not (stands.sum(axis=1) >= _FEWEST).any():
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
    # The prior of a fitted shape has a smaller σ than its uncertainty, to hold its own
    # against keypoints whose errors are correlated; so has what else tells sizes.
    own = weights.ground_sigma * np.where(view.fitted, weights.shape_sigma, 1.0)
    sigma = np.where(used, own[:, None] * np.sqrt(count), np.inf)
    if not used.any() or level > -_LOWEST_CAMERA:
        return none
    return eqx.tree_at(
        lambda f: (f.offset, f.sigma),
        bare,
        (jnp.full(present.shape, -level), jnp.asarray(sigma)),
    )


def people_on_floor(problem: graph.Problem) -> Bool[np.ndarray, " h"] | None:
    """Who stands on the floor; `None` if nobody does."""
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
    """The height of the floor over the camera, m, and who stands on it.

    `height` is that of people's lower foot over the camera, `places` where they are in
    the plane. Of all floors that one person stands on it is the one that most frames
    agree with.
    """
    count = used.sum(axis=1)
    some = np.flatnonzero(count >= _FEWEST)
    on = np.zeros(len(height), bool)
    if not len(some):
        return 0.0, on
    own = np.array([np.median(height[h, used[h]]) for h in some])
    sigma = np.hypot(_FOOT, _SIZE * own)
    middle = np.array([np.median(places[h, used[h]], axis=0) for h in some])
    way = np.linalg.norm(middle[:, None] - middle, axis=-1)
    error = np.hypot(np.hypot(sigma[:, None], sigma), _TILT * way)
    agree = np.abs(own[:, None] - own) < _OFF * error
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
    cameras = np.asarray(state.cameras)
    roots = cameras @ np.asarray(state.roots)
    joints = np.asarray(_local_joints(body, state.poses, state.shapes[:, None]))
    feet = joints[..., list(FEET), :] @ np.swapaxes(roots[..., :3, :3], -1, -2)
    feet = feet + roots[..., None, :3, 3]
    standing = toes_standing(None if probability is None else np.asarray(probability))
    return level(
        cameras,
        roots,
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
