"""The first run: loops are compiled by several processes, each once, and later runs find all."""

import gc
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import hybrid.runtime.first_run as first_run
from hybrid.runtime.first_run import MOST, FirstRun
from hybrid.runtime.signatures import FILE

ROOT = Path(__file__).parents[3]
HELPER = """
import runpy, sys
from pathlib import Path
import hybrid.runtime.signatures as signatures
signatures.FILE = Path(sys.argv[1])
runpy.run_module("hybrid.runtime.first_run", run_name="__main__")
"""
RUN = """
import subprocess, sys
from hybrid.runtime.threads import prepare_libraries
prepare_libraries()
import numpy as np
from numba.core import event
import hybrid.runtime.compiled
from nlm.samples import average_neighbours, blend_samples

subprocess.run([sys.executable, "-c", sys.argv[1], sys.argv[2]], check=True)
window, image = np.zeros((3, 4, 4, 3), np.float32), np.zeros((4, 4, 3), np.float32)
confidence = np.zeros(window.shape[:3], np.float32)
with event.install_recorder("numba:compile") as compiled:
    blend_samples(image, image, average_neighbours(window, [(0, window)], confidence, confidence, image, image), 1.0)
loops = (each.data["dispatcher"].py_func for _, each in compiled.buffer if each.is_start)
print(*(loop.__name__ for loop in loops if loop.__module__ == "nlm.samples"))
"""


def test_loops_that_a_helper_has_compiled_are_found(tmp_path):
    """A helper changed the key of numba's cache, and the first run compiled all of it again."""
    listed = {name: types for name, types in json.loads(FILE.read_text()).items() if name.startswith("nlm.samples.")}
    named = {"nlm.samples._blend_shared", "nlm.samples._compare", "nlm.samples._average"}
    assert named <= listed.keys()  # of the types of these some are named tuples, and tuples
    (tmp_path / "listed.json").write_text(json.dumps(listed))
    env = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    words = [sys.executable, "-c", RUN, HELPER, str(tmp_path / "listed.json")]
    done = subprocess.run(words, env=env, cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


COUNT = """
import sys
from numba.core import event
from hybrid.cli import main

with event.install_recorder("numba:compile") as compiled:
    code = main(sys.argv[1:])
print(*(each.data["dispatcher"].__name__ for _, each in compiled.buffer if each.is_start))
sys.exit(code)
"""


@pytest.mark.reliability
def test_a_second_run_compiles_nothing_while_helpers_of_the_first_still_work(shot_folder, tmp_path):
    env = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache"), "NUMBA_NUM_THREADS": "2"}
    words = [sys.executable, "-c", COUNT, "denoise", str(shot_folder), "-o", str(tmp_path / "out"), "--preset", "draft"]
    made = [
        subprocess.run(words, env=env, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
        for _ in range(2)
    ]
    assert made[0]
    assert made[1] == []


@pytest.mark.parametrize(("threads", "helpers"), [(1, 0), (2, 1), (4, 3), (64, MOST)])
@pytest.mark.parametrize("neural", [True, False])
def test_each_core_beside_the_first_has_a_helper(monkeypatch, threads, helpers, neural):
    started = []
    monkeypatch.setattr(first_run, "thread_count", lambda: threads)
    monkeypatch.setattr(subprocess, "Popen", lambda words, **_: started.append(words[-1]))
    monkeypatch.delitem(sys.modules, "torch", raising=False)
    if neural:
        monkeypatch.setitem(sys.modules, "torch", object())
    first_run._start_helpers()
    assert started == ["network.cpu.first_run"] * (neural and helpers > 0) + ["hybrid.runtime.first_run"] * helpers


@pytest.mark.parametrize("collects", [True, False])
def test_no_garbage_is_looked_for_while_a_loop_is_compiled(collects):
    """It took a fifth of the compilation; a loop that calls others compiles these first."""
    watch, was = FirstRun(), gc.isenabled()
    watch.begun = True  # no helper processes
    try:
        (gc.enable if collects else gc.disable)()
        watch.on_start(None)
        watch.on_start(None)
        watch.on_end(None)
        assert not gc.isenabled()
        watch.on_end(None)
        assert gc.isenabled() == collects
    finally:
        (gc.enable if was else gc.disable)()
