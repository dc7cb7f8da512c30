"""The program beside a first run compiles all of this package that the run needs."""

import numpy as np
from numba.core import event

from hybrid.denoising.first_pass import Classical
from hybrid.denoising.pseudo_reference import DRAFT
from hybrid.denoising.stream import FrameStream
from hybrid.files.shots import open_shot
from hybrid.neural import open_network, shipped_weights
from hybrid.neural.oidn_networks import denoise_bundled
from network.cpu.first_run import compile_loops
from tests.scenes import Scene, only


def test_a_run_compiles_nothing_more(tmp_path) -> None:
    """Loops for other types would be compiled in vain."""
    compile_loops()
    scene = Scene(height=40, width=48, frames=5)
    denoiser = open_network(shipped_weights("balanced"))
    stream = FrameStream(open_shot(scene.write(tmp_path)), only({"warp"}), first_pass=Classical(DRAFT))
    window = stream.align(scene.first + 2)
    with event.install_recorder("numba:compile") as compiled:
        denoise_bundled(*(np.full((40, 48, 3), 0.5, np.float32),) * 3, quality="fast")
        denoiser(window)
    loops = (each.data["dispatcher"].py_func for _, each in compiled.buffer)
    assert [loop.__qualname__ for loop in loops if loop.__module__.startswith("network")] == []
