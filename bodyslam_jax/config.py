"""Every setting, one frozen class per stage; no JAX here, so that `--help` is quick.

The command line and `config.yaml` are generated from these classes.
"""
