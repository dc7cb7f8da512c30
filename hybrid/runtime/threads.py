"""Thread counts of compiled loops, torch, OpenCV and OIDN, which have pools of their own, and their waiting policy."""

import os
import sys

#: Where numba looks for a folder for compiled loops: its own list, and after that ours (`hybrid.runtime.compiled`).
CACHE_LOCATORS = "UserProvidedCacheLocator,InTreeCacheLocator,UserWideCacheLocator,hybrid.runtime.compiled.Fallback"
SPINS = 3000  # spins of a waiting thread of GNU's OpenMP before it sleeps: 1,000 and 10,000 are nearly as good


MOST_THREADS = 1024  # more is a mistake: numba ends with a segmentation fault if it starts a hundred thousand


def check_thread_counts() -> None:
    """Raise ValueError for thread counts in the environment that the libraries warn about, ignore, or crash with.

    They must be whole numbers from 1 to `MOST_THREADS`; OpenMP takes several, one for each level of nesting. An empty
    variable is removed.
    """
    for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        said = os.environ.get(name, "")
        if not said.strip():
            os.environ.pop(name, None)
            continue
        for count in said.split(",") if name == "OMP_NUM_THREADS" else (said,):
            text = count.strip()
            if not (text.isdecimal() and len(text) < 9 and 1 <= int(text) <= MOST_THREADS):
                raise ValueError(f"{name} is {said[:60]!r}, expected a number of threads from 1 to {MOST_THREADS}")


def let_waiting_threads_sleep() -> None:
    """Let OpenMP's threads sleep after `SPINS` spins of waiting, unless the environment states a policy.

    By default they spin for long, which takes a core from other processes: on two cores under six times their load
    `denoise` at 960×540 took 2.4 times the CPU time of a run whose threads slept, and 2.2 times the wall time. Most
    waits are shorter than falling asleep and waking up: with `SPINS` spins first, ten frames of 1920×1080 took 0.97 of
    the CPU time and 0.92 of the wall time. Under five times the load of the machine they cost 13 % more. Must be called
    before numba or torch is imported, which read these variables once; child processes inherit them.
    """
    if os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE").upper() == "PASSIVE":
        os.environ.setdefault("GOMP_SPINCOUNT", str(SPINS))


def prepare_libraries() -> None:
    """Set environment variables that numba and OpenMP read once; to be called before either is imported."""
    os.environ.setdefault("NUMBA_CACHE_LOCATOR_CLASSES", CACHE_LOCATORS)
    # Straight-line code for several channels becomes one operation: a bicubic warp takes 0.75 of the time.
    os.environ.setdefault("NUMBA_SLP_VECTORIZE", "1")
    let_waiting_threads_sleep()


def limit_threads(count: int) -> None:
    """Limit compiled loops, OpenCV and torch to `count` threads; OIDN is limited at each call."""
    import cv2

    from loops.parallel import limit_loops

    # If torch is imported later, it takes MKL's number.
    os.environ["OMP_NUM_THREADS"] = os.environ["MKL_NUM_THREADS"] = str(count)
    cv2.setNumThreads(count)
    limit_loops(count)
    if (torch := sys.modules.get("torch")) is not None:
        torch.set_num_threads(count)
