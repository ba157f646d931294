"""Results published in the paper, on its own recordings, which were not released.

Henning, Laidlow, Leutenegger, "BodySLAM", ECCV 2022: table 1 and the appendix. The data
differ from ours: in our tables the values indicate the order of magnitude only.
"""

_ROWS = """
E1 108.1 44.3 42.4 43.5 114.0 56.3 106.5 56.0 154.8 118.8 149.8 115.9 0.671 0.940
E2 193.0 50.8 50.7 49.1 178.6 55.0 182.8 53.0 210.9 124.2 214.6 120.5 0.581 1.030
E3 122.3 40.9 40.8 38.9 220.8 160.9 217.1 160.4 247.7 196.1 244.3 192.8 0.738 0.981
M1 314.7 92.6 93.3 91.0 326.9 201.4 314.6 200.0 368.8 236.2 355.3 236.2 0.502 0.978
M2 241.6 64.0 57.9 61.1 368.1 295.4 353.5 297.1 408.6 323.3 392.0 325.4 0.507 0.936
M3 392.1 128.3 128.0 128.1 311.2 121.7 305.9 122.2 335.5 170.2 326.4 171.9 0.354 0.985
M4 203.1 92.4 91.3 90.9 153.7 70.4 142.8 71.7 184.2 123.0 175.0 125.3 0.635 0.951
D1 310.4 108.1 107.0 103.5 303.7 136.7 293.9 135.9 330.6 180.6 321.1 181.1 0.445 0.951
D2 316.0 100.0 98.9 95.2 297.6 91.2 283.5 90.6 320.6 142.6 306.8 143.8 0.430 0.933
D3 246.9 115.3 113.0 114.0 235.4 149.9 228.8 149.5 264.5 183.9 258.0 185.0 0.494 0.942
"""
TABLE1 = {
    name: tuple(map(float, values))
    for name, *values in (line.split() for line in _ROWS.split("\n") if line)
}
"""For each of C-ATE, H-ATE and J-ATE, mm: SE(3) without motion model, SE(3) full,
Sim(3) without motion model, Sim(3) full; then the scale of both."""

SCALE = {
    5.0: (3.673, 26.5),
    2.0: (2.106, 5.3),
    1.0: (1.051, 5.1),
    0.5: (0.528, 5.6),
    0.2: (0.224, 12.0),
    0.1: (0.124, 24.0),
}
"""Estimated s and its deviation in per cent, by perturbation 1/s' (appendix D)."""

STRUCTURE = {
    "E2": (193.0, 213.1, 139.69, 138.52),
    "E3": (122.3, 136.0, 78.03, 75.56),
    "M4": (203.1, 225.2, 143.03, 139.4),
    "D1": (310.4, 340.7, 223.08, 219.1),
    "D2": (316.0, 349.1, 209.48, 205.28),
}
"""C-ATE SE(3) in mm: original, perturbed, without and with landmarks (appendix C)."""

MOTION = (3.4, 18.4)
"""Mean error of the predicted translation and mean step, mm per frame (section 4.4)."""

OTHER_DATA = (
    "Ours: simulated sequences. The paper's: its own recordings, which were never "
    "released; other data, so the two do not compare."
)


def table1_row(sequence: str) -> dict[str, float]:
    """Returns the paper's row with the keys of `compare_methods`, in SI units."""
    names = [
        f"{method}/{error}_{group}"
        for error in ("c_ate", "h_ate", "j_ate")
        for group in ("se3", "sim3")
        for method in ("no_mm", "full")
    ]
    values = TABLE1[sequence]
    row = {name: 1e-3 * v for name, v in zip(names, values[:12], strict=True)}
    return row | {"no_mm/scale": values[12], "full/scale": values[13]}
