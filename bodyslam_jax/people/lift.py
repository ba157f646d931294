"""Lifting of 2-D keypoints to a 3-D posture by a small network.

Depth is ambiguous in a single view but better determined by a second of motion. After
Martinez et al., *A simple yet effective baseline for 3d human pose estimation* (ICCV
2017), dense layers map the keypoints of about a second to the posture and heading in
its middle, with standard deviations. The fit uses it as a robust measurement beside the
keypoints and as its start.

Trained by `tools/train_lifter.py` on CMU motion capture with random cameras; see
`assets/README.md`.
"""

import functools
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from bodyslam_jax.geometry.camera import unproject
from bodyslam_jax.io.archive import read_npz
from bodyslam_jax.people.costs import KEYPOINT_SIGMA, Lifted

ASSET = Path(__file__).parent / "assets" / "lifter.npz"
HELD_OUT_ASSET = ASSET.with_name("lifter_held_out.npz")
ASSETS = {"everybody": ASSET, "held-out": HELD_OUT_ASSET}
"""Files by the setting `PeopleFit.lifter`."""
SPACING_S = 0.1
"""Time between the network's input frames, s."""
NUM_SIDE_FRAMES = 5
"""Number of input frames before, and after, the middle one."""
NUM_FEATURES = (2 * NUM_SIDE_FRAMES + 1) * 25 * 3
_KEPT_SHARE = 0.8
"""Share of hidden units that dropout keeps in training."""
_NECK, _HIPS = 1, 8
"""Keypoints of BODY_25."""
_INPUT_RMS = 0.5
"""Root mean square of the input coordinates, in the frame where it is largest."""
_MIN_KEYPOINTS = 6
"""Least number of keypoints of a frame that is used."""


class Lifter(eqx.Module):
    """Dense layers with two skips; `f` features of `h` hidden units; `k` components of
    posture (`PosturePrior`)."""

    first: Float[Array, "f h"]
    hidden: Float[Array, "3 h h"]
    last: Float[Array, "h o"]
    """`o = 2 k + 7`: posture, root (two columns of its rotation), logarithms of the
    deviations of each component of posture and of the turn."""
    bias: Float[Array, "4 h"]
    last_bias: Float[Array, " o"]

    def __call__(
        self, x: Float[Array, "*b f"], key: PRNGKeyArray | None = None
    ) -> Lifted:
        """Predicts from features; with a key, with dropout, for training."""
        drop = lambda h, number: h if key is None else _dropped(h, key, number)
        h = drop(jax.nn.relu(x @ self.first + self.bias[0]), 0)
        inner = drop(jax.nn.relu(h @ self.hidden[0] + self.bias[1]), 1)
        h = h + jax.nn.relu(inner @ self.hidden[1] + self.bias[2])
        h = drop(h + jax.nn.relu(h @ self.hidden[2] + self.bias[3]), 2)
        out = h @ self.last + self.last_bias
        # 2 k + 7 outputs, as `last` says.
        k = (out.shape[-1] - 7) // 2
        return Lifted(
            orientation=_orthonormal(out[..., k : k + 6]),
            latent=out[..., :k],
            latent_sigma=jnp.exp(jnp.clip(out[..., k + 6 : -1], -4.0, 3.0)),
            turn_sigma=jnp.exp(jnp.clip(out[..., -1], -4.0, 1.0)),
        )


def _dropped(
    h: Float[Array, "*b h"], key: PRNGKeyArray, number: int
) -> Float[Array, "*b h"]:
    keep = jax.random.bernoulli(jax.random.fold_in(key, number), _KEPT_SHARE, h.shape)
    return h * keep.astype(h.dtype) / _KEPT_SHARE


def _orthonormal(columns: Float[Array, "*b 6"]) -> Float[Array, "*b 3 3"]:
    """Returns the rotation of two columns by Gram and Schmidt (Zhou et al., CVPR
    2019)."""
    unit = lambda v: v / jnp.sqrt(jnp.sum(v**2, -1, keepdims=True) + 1e-12)
    x, y = unit(columns[..., :3]), columns[..., 3:]
    y = unit(y - jnp.sum(x * y, -1, keepdims=True) * x)
    return jnp.stack([x, y, jnp.cross(x, y)], -1)


@functools.cache
def load_lifter(path: Path = ASSET) -> Lifter:
    """Returns the network that is used by default, or that of a file, in float32."""
    archive = read_npz(path, "a lifting network (.npz)")
    names = ("first", "hidden", "last", "bias", "last_bias")
    return Lifter(*(jnp.asarray(archive.array(n), jnp.float32) for n in names))


@eqx.filter_jit
def lift(
    lifter: Lifter,
    intrinsics: Float[Array, " i"],
    uv: Float[Array, "t 25 2"],
    sigma: Float[Array, "t 25"],
    fps: Float[Array, ""],
) -> tuple[Lifted, Bool[Array, " t"]]:
    """Returns predicted postures in the camera frame for all frames of one person.

    **Arguments:** `sigma`, as `keypoint_sigma` has it: m, `inf` for missing keypoints.

    **Returns:** the predictions, and the frames with enough keypoints for one.
    """
    x, view, valid = features(intrinsics, uv, sigma, fps)
    found = lifter(x)
    orientation = jnp.swapaxes(view, -1, -2) @ found.orientation.astype(view.dtype)
    found = jax.tree.map(lambda a: a.astype(uv.dtype), found)
    return eqx.tree_at(lambda f: f.orientation, found, orientation), valid


def features(
    intrinsics: Float[Array, " i"],
    uv: Float[Array, "t 25 2"],
    sigma: Float[Array, "t 25"],
    fps: Float[Array, ""],
) -> tuple[Float[Array, "t f"], Float[Array, "t 3 3"], Bool[Array, " t"]]:
    """Returns the network's input, the rotation from C to the frame of the input, and
    the frames with enough keypoints.

    The z axis of that frame is the ray to the person, the trunk is upright in it on
    average over the window, and coordinates are scaled to a size of 1/2. So the input
    is invariant to position, focal length and rotation of the camera.
    """
    relative = jnp.where(
        sigma < jnp.inf, jnp.asarray(KEYPOINT_SIGMA, uv.dtype) / sigma, 0
    )
    enough = jnp.sum(relative > 0, axis=1) >= _MIN_KEYPOINTS
    mark = jnp.where(enough[:, None], relative, 0)
    present = mark > 0
    rays = jnp.where(present[..., None], unproject(intrinsics, uv), 0)
    length = jnp.sqrt(jnp.sum(rays**2, -1, keepdims=True))
    middle = jnp.sum(rays / jnp.maximum(length, 1), axis=1)
    ahead = jnp.array([0.0, 0.0, 1.0], uv.dtype)
    view = _turn_to_axis(jnp.where(enough[:, None], middle, ahead))
    turned = jnp.einsum("tij,tkj->tki", view, rays)
    flat = turned[..., :2] / jnp.maximum(turned[..., 2:], 0.1)
    count = jnp.maximum(jnp.sum(present, axis=1), 1).astype(uv.dtype)
    size = jnp.sqrt(jnp.sum(flat**2, (1, 2)) / count)
    trunk = flat[:, _NECK] - flat[:, _HIPS]
    trunk = jnp.where((present[:, _NECK] & present[:, _HIPS])[:, None], trunk, 0)

    step = (
        jnp.arange(-NUM_SIDE_FRAMES, NUM_SIDE_FRAMES + 1, dtype=uv.dtype)
        * SPACING_S
        * fps
    )
    index = jnp.arange(len(uv))[:, None] + jnp.round(step).astype(int)
    index = jnp.clip(index, 0, len(uv) - 1)
    upright = _turn_upright(jnp.sum(trunk[index], axis=1))
    largest = jnp.maximum(jnp.max(size[index], axis=1), 1e-6)
    shape = jnp.einsum("tij,twkj->twki", upright[:, :2, :2], flat[index])
    shape = shape * (_INPUT_RMS / largest)[:, None, None, None]
    x = jnp.concatenate([shape, mark[index][..., None]], -1)
    x = x.reshape(len(uv), NUM_FEATURES).astype(jnp.float32)
    return x, upright @ view, enough


def _turn_upright(trunk: Float[Array, "t 2"]) -> Float[Array, "t 3 3"]:
    """Returns the rotation about z by which the trunk points to -y; the identity where
    it is not visible."""
    length = jnp.sqrt(jnp.sum(trunk**2, -1, keepdims=True))
    up = jnp.array([0.0, -1.0], trunk.dtype)
    x, y = jnp.where(length > 1e-6, trunk / jnp.maximum(length, 1e-6), up).T
    zero, one = jnp.zeros_like(x), jnp.ones_like(x)
    rows = [[-y, x, zero], [-x, -y, zero], [zero, zero, one]]
    return jnp.stack([jnp.stack(row, -1) for row in rows], -2)


def _turn_to_axis(ray: Float[Array, "t 3"]) -> Float[Array, "t 3 3"]:
    """Returns the smallest rotation that takes each ray to +z; no ray points to -z."""
    x, y, z = (ray / jnp.linalg.norm(ray, axis=-1, keepdims=True)).T
    h = 1 / (1 + z)
    rows = [[1 - h * x * x, -h * x * y, -x], [-h * x * y, 1 - h * y * y, -y], [x, y, z]]
    return jnp.stack([jnp.stack(row, -1) for row in rows], -2)
