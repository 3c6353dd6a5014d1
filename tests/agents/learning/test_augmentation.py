import numpy as np

from agents.learning.networks import moved


def _shifted(raw: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """By NumPy's padding: `rows` down and `columns` to the right, borders continued."""
    height, width = raw.shape[2:]
    padded = np.pad(raw, ((0, 0), (0, 0), (2, 2), (2, 2)), mode="edge")
    return padded[:, :, 2 - rows : 2 - rows + height, 2 - columns : 2 - columns + width]


def test_frames_are_shifted_by_up_to_an_eighth_and_mirrored() -> None:
    rng = np.random.default_rng(0)
    raw = rng.integers(0, 256, (3, 4, 16, 16), dtype=np.uint8)
    known = {
        (r, c, m): _shifted(raw, r, c)[..., :: -1 if m else 1]
        for r in range(-2, 3)
        for c in range(-2, 3)
        for m in (False, True)
    }
    seen = set()
    for _ in range(600):
        found = moved(raw, rng)
        seen.add(next(key for key, frames in known.items() if np.array_equal(frames, found)))
    assert seen == set(known)
