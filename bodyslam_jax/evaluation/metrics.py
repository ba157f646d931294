"""Errors of cameras and people, each with its exact definition and its source.

Arrays are those of one person and one camera over `t` frames; `valid` marks the frames
that are evaluated, and values in others are ignored. An error is an array with a mask
of its own (`Errors`), which has a `mean` and an `rmse`. Units are SI: m, rad, s. The
estimate is the first argument, the truth the second. Differences in time are taken
between neighbouring valid frames, never across a gap; RTE and the 100-frame chunks drop
invalid frames first, as their sources do.
"""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.evaluation.alignment import (
    Similarity,
    similarity_from_moments,
    umeyama,
)
from bodyslam_jax.geometry import so3

Chunking = Literal["wham", "tram"]
CHUNK_FRAMES = 100
"""Frames per chunk of W-MPJPE and WA-MPJPE."""


class Errors(eqx.Module):
    """Errors, one per frame (and joint), with a mask of those that exist."""

    value: Float[Array, "*n"]
    valid: Bool[Array, "*n"]

    def mean(self) -> Float[Array, ""]:
        """Returns the mean over the errors that exist; NaN without any."""
        return self._average(self.value)

    def rmse(self) -> Float[Array, ""]:
        """Returns the root mean square of the errors that exist; NaN without any."""
        return _sqrt(self._average(self.value**2))

    def _average(self, value: Float[Array, "*n"]) -> Float[Array, ""]:
        count = jnp.sum(self.valid).astype(value.dtype)
        total = jnp.sum(jnp.where(self.valid, value, 0))
        return jnp.where(count > 0, total / jnp.maximum(count, 1), jnp.nan)


def norm(x: Float[Array, "*n d"]) -> Float[Array, "*n"]:
    """Returns the length of each vector, with derivative 0 where it is zero."""
    # The sum is written out: XLA on CPU does not vectorise it over so short an axis.
    square = sum((x[..., k] ** 2 for k in range(1, x.shape[-1])), x[..., 0] ** 2)
    return _sqrt(square)


def _sqrt(square: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Returns the square root, with a derivative of 0 at 0; NaN stays NaN.

    `where(square == 0, ...)` inside and outside of the root is not safe: XLA may
    compute `square` twice with different rounding, so that one finds 0 and the other
    does not.
    """
    tiny = jnp.finfo(square.dtype).tiny
    return jnp.sqrt(square + tiny) - np.sqrt(tiny)


def only(valid: Bool[Array, " t"], *arrays: Float[Array, "t ..."]) -> list[Array]:
    """Returns the arrays with zeros in invalid frames, so that NaN there does not
    propagate."""
    shaped = lambda x: valid.reshape(valid.shape + (1,) * (x.ndim - 1))
    return [jnp.where(shaped(x), x, 0) for x in arrays]


def trajectory_error(
    estimate: Float[Array, "t 3"],
    truth: Float[Array, "t 3"],
    valid: Bool[Array, " t"],
    alignment: Similarity,
) -> Errors:
    """Returns the distance of each aligned position from the truth, m.

    With camera centres it is C-ATE, with the pelvis joint (origin of H) H-ATE; Henning
    et al., ECCV 2022, section 4. "ATE" is the RMSE of these distances in Sturm et al.,
    IROS 2012, and their mean in TRAM (in evo: `mean`). ATE-S (TRAM) is the mean of
    C-ATE after SE(3) alignment.
    """
    estimate, truth = only(valid, estimate, truth)
    return Errors(norm(alignment.apply(estimate) - truth), valid)


def joint_trajectory_error(
    estimate: Float[Array, "t j 3"],
    truth: Float[Array, "t j 3"],
    valid: Bool[Array, " t"],
    alignment: Similarity,
) -> Errors:
    """Returns J-ATE: the distance of every aligned joint from the truth, m.

    Henning et al., ECCV 2022, table 1. They do not state how joints are aligned; here
    `alignment` is that of the human centres (pelvis joints).
    """
    estimate, truth = only(valid, estimate, truth)
    value = norm(alignment.apply(estimate) - truth)
    return Errors(value, jnp.broadcast_to(valid[:, None], value.shape))


def relative_pose_errors(
    estimate: Float[Array, "t 4 4"],
    truth: Float[Array, "t 4 4"],
    valid: Bool[Array, " t"],
    step: int = 1,
) -> tuple[Errors, Errors]:
    """Returns the RPE over `step` frames: translation, m, and rotation, rad, of the
    relative pose.

    It is `E_i = (Q_i⁻¹ Q_{i+step})⁻¹ (P_i⁻¹ P_{i+step})` for every `i` (Sturm et al.,
    IROS 2012, eq. 2; evo's `RPE` with `all_pairs`), and needs no alignment.
    """

    def relative(T):
        rotation = jnp.swapaxes(T[:-step, :3, :3], -1, -2)
        moved = T[step:, :3, 3] - T[:-step, :3, 3]
        return rotation @ T[step:, :3, :3], (rotation @ moved[..., None])[..., 0]

    still = jnp.eye(4, dtype=truth.dtype)
    kept = lambda T: relative(jnp.where(valid[:, None, None], T, still))
    (R, t), (R_true, t_true) = kept(estimate), kept(truth)
    turned = jnp.swapaxes(R_true, -1, -2)
    angle = norm(so3.log(turned @ R))
    both = valid[step:] & valid[:-step]
    # |R_trueᵀ (t - t_true)| is the translation of E; the rotation keeps its length.
    return Errors(norm(t - t_true), both), Errors(angle, both)


def camera_frame(
    joints: Float[Array, "t j 3"], T_WC: Float[Array, "t 4 4"]
) -> Float[Array, "t j 3"]:
    """Returns the joints in each frame's camera frame, m."""
    return jnp.einsum("tji,tnj->tni", T_WC[:, :3, :3], joints - T_WC[:, None, :3, 3])


def hip_centred(joints: Float[Array, "t j 3"]) -> Float[Array, "t j 3"]:
    """Returns the joints relative to the mean of the hips (joints 1 and 2), m."""
    return joints - jnp.mean(joints[:, 1:3], 1, keepdims=True)


def mpjpe(
    estimate: Float[Array, "t j 3"],
    truth: Float[Array, "t j 3"],
    valid: Bool[Array, " t"],
) -> Errors:
    """Returns MPJPE in the camera frame, m, with both centred at the mean of the hips.

    EMDB's evaluation (`eth-ait/emdb`), where the pelvis is the middle of the hips.
    """
    estimate, truth = only(valid, estimate, truth)
    value = norm(hip_centred(estimate) - hip_centred(truth))
    return Errors(value, jnp.broadcast_to(valid[:, None], value.shape))


def pa_mpjpe(
    estimate: Float[Array, "t j 3"],
    truth: Float[Array, "t j 3"],
    valid: Bool[Array, " t"],
) -> Errors:
    """Returns PA-MPJPE, m: the error after the best Sim(3) of each frame
    (Procrustes)."""
    estimate, truth = only(valid, estimate, truth)
    found = umeyama(truth, estimate, with_scale=True)
    value = norm(jax.vmap(Similarity.apply)(found, estimate) - truth)
    return Errors(value, jnp.broadcast_to(valid[:, None], value.shape))


def _chunks(valid: Bool[Array, " t"], chunking: Chunking):
    """Returns the chunk of each frame, its index within the chunk counting valid frames
    only, and whether it belongs to a chunk at all: TRAM drops some."""
    rank = jnp.cumsum(valid) - 1
    if chunking == "wham":
        return rank // CHUNK_FRAMES, rank % CHUNK_FRAMES, valid
    if chunking != "tram":
        raise InputError(f"Chunking {chunking!r}, not 'wham' or 'tram'.")
    num_valid = jnp.sum(valid)
    num_chunks = (num_valid - 1) // CHUNK_FRAMES
    end = jnp.where(
        num_valid % CHUNK_FRAMES == 0, num_chunks * CHUNK_FRAMES, num_valid - 1
    )
    short = num_chunks < 1
    chunk = jnp.where(short, 0, jnp.minimum(rank // CHUNK_FRAMES, num_chunks - 1))
    return chunk, rank - chunk * CHUNK_FRAMES, valid & (short | (rank < end))


def world_mpjpe(
    estimate: Float[Array, "t j 3"],
    truth: Float[Array, "t j 3"],
    valid: Bool[Array, " t"],
    align_with: Literal["all", "first"] = "first",
    chunking: Chunking = "wham",
) -> Errors:
    """Returns W-MPJPE₁₀₀ (`"first"`) or WA-MPJPE₁₀₀ (`"all"`): the mean over joints per
    frame, m.

    The valid frames are cut into chunks of 100. In each, one Sim(3) is fitted to all
    joints of its first two frames (W) or of all its frames (WA), and applied to the
    chunk; the scale is aligned, too (WHAM `lib/eval/eval_utils.py`,
    `first_align_joints`, `global_align_joints`). With `"wham"`, the last chunk is the
    remainder, 1 to 99 frames. With `"tram"` (`scripts/emdb/run_eval.py`), chunks start
    at `range(0, n - 100, 100)`, and the last one extends to frame `n - 2` unless `n` is
    a multiple of 100, when the last 100 frames are in no chunk. TRAM has no chunk at
    all for `n <= 100`; here that is one chunk of all frames.

    **Raises:** `InputError` for another `chunking`.
    """
    estimate, truth = only(valid, estimate, truth)
    chunk, place, used = _chunks(valid, chunking)
    num_chunks = (len(valid) + CHUNK_FRAMES - 1) // CHUNK_FRAMES
    chunk = jnp.clip(chunk, 0, num_chunks - 1)
    fits = used & (place < 2) if align_with == "first" else used
    weight = fits.astype(truth.dtype)
    total = lambda x: jax.ops.segment_sum(x, chunk, num_chunks)
    count = jnp.maximum(total(weight), 1) * truth.shape[1]
    at = lambda x: jnp.sum(x * weight[:, None, None], 1)
    truth_mean = total(at(truth)) / count[:, None]
    mean = total(at(estimate)) / count[:, None]
    y, x = truth - truth_mean[chunk][:, None], estimate - mean[chunk][:, None]
    outer = jnp.einsum("tna,tnb->tab", y, x) * weight[:, None, None]
    square = jnp.sum(x**2, (1, 2)) * weight
    found = similarity_from_moments(
        truth_mean,
        mean,
        total(outer) / count[:, None, None],
        total(square) / count,
        with_scale=True,
    )
    moved = found.scale[chunk][:, None, None] * jnp.einsum(
        "tab,tnb->tna", found.rotation[chunk], x
    )
    return Errors(jnp.mean(norm(moved - y), 1), used)


def root_trajectory_error(
    estimate: Float[Array, "t 3"],
    truth: Float[Array, "t 3"],
    valid: Bool[Array, " t"],
) -> Errors:
    """Returns RTE: the error of the root after one SE(3) alignment, as a fraction of
    the path's length.

    WHAM's `compute_rte` (there × 100, of SMPL's `trans`; here of the pelvis joint, as
    in GVHMR and TRAM). Invalid frames are dropped first. A true path shorter than 1 mm
    counts as 1 mm, so that the figure stays finite.
    """
    estimate, truth = only(valid, estimate, truth)
    order = jnp.argsort(~valid, stable=True)
    moved = norm(jnp.diff(truth[order], axis=0))
    length = jnp.sum(jnp.where(jnp.arange(1, len(valid)) < jnp.sum(valid), moved, 0))
    found = umeyama(truth, estimate, valid.astype(truth.dtype))
    value = norm(found.apply(estimate) - truth) / jnp.maximum(length, 1e-3)
    return Errors(value, valid)


def acceleration_error(
    estimate: Float[Array, "t j 3"],
    truth: Float[Array, "t j 3"],
    valid: Bool[Array, " t"],
    fps: Float[Array, ""],
) -> Errors:
    """Returns `|Δ²x - Δ²x̂| fps²` per joint, m/s² (Kanazawa et al., CVPR 2019).

    WHAM takes hip-centred joints of the camera frame and leaves out the first and the
    last value; all are kept here.
    """
    estimate, truth = only(valid, estimate, truth)
    value = norm(jnp.diff(estimate - truth, n=2, axis=0)) * fps**2
    return Errors(value, jnp.broadcast_to(_run(valid, 2)[:, None], value.shape))


def jitter(
    joints: Float[Array, "t j 3"], valid: Bool[Array, " t"], fps: Float[Array, ""]
) -> Errors:
    """Returns the norm of the joints' third difference in the world times fps³, m/s³.

    WHAM and GVHMR print a tenth of it ("10 m/s³"). EMDB's jitter has another definition
    (reference frame, and joints set to zero).
    """
    (joints,) = only(valid, joints)
    value = norm(jnp.diff(joints, n=3, axis=0)) * fps**3
    return Errors(value, jnp.broadcast_to(_run(valid, 3)[:, None], value.shape))


def foot_sliding(
    estimate: Float[Array, "t f 3"],
    truth: Float[Array, "t f 3"],
    valid: Bool[Array, " t"],
) -> Errors:
    """Returns the displacement of foot points per frame while the true points stand, m.

    A point stands where the truth moves less than 1 cm from one frame to the next.
    WHAM `compute_foot_sliding`, with SMPL's vertices 3216, 3387, 6617, 6787 (big toes
    and heels) and 30 fps.
    """
    estimate, truth = only(valid, estimate, truth)
    step, true_step = norm(jnp.diff(estimate, axis=0)), norm(jnp.diff(truth, axis=0))
    return Errors(step, (true_step < 0.01) & _run(valid, 1)[:, None])


def _run(valid: Bool[Array, " t"], order: int) -> Bool[Array, " u"]:
    """Returns where `order + 1` consecutive frames are valid."""
    for _ in range(order):
        valid = valid[1:] & valid[:-1]
    return valid
