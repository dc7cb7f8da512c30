import numpy as np

from hybrid.files.passes import BEAUTY, Passes, Sum


def test_a_sum_that_is_none_in_a_frame_is_left_out_there():
    rng = np.random.default_rng(1)
    key, fill = (np.float32(rng.gamma(4, 0.25, (32, 48, 3))) for _ in range(2))
    passes = Passes((Sum(BEAUTY, ("key", "fill")), Sum(BEAUTY, ("direct",), complete=False)))
    lights = {"key": key, "fill": fill, "direct": 0.5 * fill}
    assert passes.in_frame(key + fill, lights, 1.0) == passes
    assert passes.in_frame(key + 2 * fill, lights, 1.0).sums == passes.sums[1:]
    assert passes.in_frame(0.1 * fill, lights, 1.0).sums == ()
    assert passes.in_frame(key + fill, {"direct": fill}, 1.0).sums == passes.sums[1:]
