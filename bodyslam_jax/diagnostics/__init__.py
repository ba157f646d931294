"""Whether what goes in agrees, and whether what comes out can be true."""

from bodyslam_jax.diagnostics.agreement import reconcile as reconcile
