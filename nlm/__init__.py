"""Averages over an aligned window: which pixels may be averaged, with what weight, and what is corrected afterwards.

Images are (H, W, C) float32, linear radiance or irradiance; a window is (T, H, W, C), T odd, its centre at ``T // 2``;
confidence is (T, H, W), at least 0. `exposure` is the radiance that tone mapping maps to one half; it scales with the
pictures. Functions raise ValueError, with the argument, what was expected and what came, where shapes do not fit,
T is even, or a parameter is out of its range.
"""

from nlm.average import average, reject_outliers, replace_nonfinite, robust_average
from nlm.drift import drift_weights, pull_to_centre
from nlm.fireflies import Highlights, find_bright_samples, measure_highlights, replace_fireflies
from nlm.gate import agreement_weight, color_gate, color_gates
from nlm.guided import guided_filter, measure_guide
from nlm.interpolation import interpolation_weight
from nlm.moving_lights import confirmed_by_neighbour, find_bright, passing_lights, trail_of
from nlm.nonlocal_means import joint_nlm
from nlm.parts import filter_layers, find_sums, split_light, sums_to
from nlm.pooling import PooledSamples, pool_samples
from nlm.relight import relight
from nlm.samples import SampleMean, average_neighbours, beside_lamps, blend_samples, limit_lamps, restore_mean
from nlm.variance import prefilter_guide, smooth_variance, variance_from_halves, variance_from_window

__all__ = [
    "Highlights", "PooledSamples", "SampleMean", "agreement_weight", "average", "average_neighbours",
    "beside_lamps", "blend_samples", "color_gate", "color_gates", "confirmed_by_neighbour",
    "drift_weights", "filter_layers", "find_bright", "find_bright_samples", "find_sums",
    "guided_filter", "interpolation_weight", "joint_nlm", "limit_lamps", "measure_guide", "measure_highlights",
    "passing_lights", "pool_samples", "prefilter_guide", "pull_to_centre", "reject_outliers",
    "relight", "replace_fireflies", "replace_nonfinite", "restore_mean", "robust_average", "smooth_variance",
    "split_light", "sums_to", "trail_of", "variance_from_halves", "variance_from_window",
]  # fmt: skip
