"""Whether keypoints, bodies and camera are of one video."""

from bodyslam_jax.diagnostics.agreement.reconcile import reconcile as reconcile
