"""The factors of the graph, one file for each quantity that is measured.

All are subclasses of `graph.factor.FrameFactor`, except those of landmarks. Factors are
created from measurements in `initialisation`: those of people in
`people_factors.py`, of the motion model in `motion_factors.py`, of cameras and
landmarks in `map_factors.py` and of the ground in `ground.py`; those of intrinsics in
`pipeline/sfm_stage.py`.
"""
