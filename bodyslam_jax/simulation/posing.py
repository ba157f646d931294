"""The body model in NumPy: joints, keypoints and skin without compilation.

The equations are those of `bodyslam_jax.body`, as a test verifies, for bodies without
pose blend shapes. A simulator evaluates them once per sequence, each of another length,
so that compiling would take longer than everything else.
"""

import numpy as np
from jaxtyping import Float, Int

from bodyslam_jax.body import DETECTOR_BIAS, KEYPOINT_NAMES, BodyModel
from bodyslam_jax.body.skeleton import KEYPOINT_JOINT, SURFACE_POINTS, pose_joints
from bodyslam_jax.geometry import so3_numpy as so3


class Person:
    """A person's body: one shape at rest, and functions that pose it."""

    def __init__(self, body: BodyModel, shape: Float[np.ndarray, "10"]):
        array = lambda x: np.asarray(x, np.float64)
        self.shape = shape
        self._body = body
        self._joint_template = array(body.joint_template)
        self._joint_shape_dirs = array(body.joint_shape_dirs)
        self.rest = self.rest_joints(shape)
        """Joints at rest, m, (24, 3)."""
        self.skin = array(body.template) + array(body.shape_dirs) @ shape
        """Vertices at rest, m, (v, 3)."""
        self.faces: Int[np.ndarray, "f 3"] = np.asarray(body.faces)
        self.weights = np.zeros((len(self.skin), 24))
        rows = np.arange(len(self.skin))
        for joint, weight in zip(
            np.asarray(body.skin_joint).T, array(body.skin_weight).T, strict=True
        ):
            self.weights[rows, joint] += weight
        self.picks = np.asarray(body.picks)

    def of_shape(self, shape: Float[np.ndarray, "10"]) -> "Person":
        """Returns another person of the same body model."""
        return Person(self._body, shape)

    def rest_joints(
        self, shape: Float[np.ndarray, "*b 10"]
    ) -> Float[np.ndarray, "*b 24 3"]:
        """Returns the joints at rest of other shapes of the same body model, m."""
        moved = np.einsum("jab,...b->...ja", self._joint_shape_dirs, shape)
        return self._joint_template + moved

    def joints(
        self, poses: Float[np.ndarray, "t 24 3"], pelvis: Float[np.ndarray, "t 3"]
    ) -> tuple[Float[np.ndarray, "t 24 3 3"], Float[np.ndarray, "t 24 3"]]:
        """Returns the rotations of all joints, and their positions (m), in the frame
        that the root pose rotates into."""
        return pose_joints(so3.exp(poses), self.rest, pelvis)

    def vertices(
        self,
        G: Float[np.ndarray, "24 3 3"],
        x: Float[np.ndarray, "24 3"],
        which: Int[np.ndarray, " n"] | slice = slice(None),
    ) -> Float[np.ndarray, "n 3"]:
        """Returns the vertices of one posed frame (linear blend skinning), m."""
        move = x - np.einsum("jab,jb->ja", G, self.rest)
        T = np.concatenate([G, move[:, :, None]], axis=2).reshape(24, 12)
        T = (self.weights[which] @ T).reshape(-1, 3, 4)
        return np.einsum("vab,vb->va", T[:, :, :3], self.skin[which]) + T[:, :, 3]

    def keypoints(
        self,
        G: Float[np.ndarray, "t 24 3 3"],
        x: Float[np.ndarray, "t 24 3"],
        bias: float = 0.0,
    ) -> Float[np.ndarray, "t 25 3"]:
        """Returns the BODY_25 keypoints of posed frames, m; `bias` as in
        `body.local_keypoints`."""
        out = np.empty((len(x), 25, 3))
        for k, name in enumerate(KEYPOINT_NAMES["body25"]):
            if name in SURFACE_POINTS:
                pick = self.picks[[SURFACE_POINTS.index(name)]]
                out[:, k] = [
                    self.vertices(g, y, pick)[0] for g, y in zip(G, x, strict=True)
                ]
            else:
                j = KEYPOINT_JOINT[name]
                offset = bias * np.array(DETECTOR_BIAS.get(name, (0.0, 0.0, 0.0)))
                out[:, k] = x[:, j] + G[:, j] @ offset
        return out
