"""`python -m bodyslam_jax` is the command `bodyslam`."""

from bodyslam_jax.cli import program

if __name__ == "__main__":
    program()
