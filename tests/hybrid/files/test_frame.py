import numpy as np
import pytest

from hybrid.files.frame import Frame

SIZE = 4, 6


def image(value: float, count: int = 3, size: tuple[int, int] = SIZE) -> np.ndarray:
    return np.full((*size, count), value, np.float32)


def test_frame_says_which_array_is_wrong():
    with pytest.raises(ValueError, match=r"albedo is float32 \(4, 5, 3\), expected float32 \(4, 6, 3\)"):
        Frame(1, image(1), albedo=image(1, size=(4, 5)))
    with pytest.raises(ValueError, match="color is float64"):
        Frame(1, image(1).astype(np.float64))
    with pytest.raises(ValueError, match="motion_convention"):
        Frame(1, image(1), motion=image(1, 2))
    with pytest.raises(ValueError, match="'glow'"):
        Frame(1, image(1), aovs={"glow": image(1)[..., 0]})
