"""Checks whether keypoints, bodies and camera belong to the same video."""

from bodyslam_jax.diagnostics.agreement.reconcile import reconcile as reconcile
