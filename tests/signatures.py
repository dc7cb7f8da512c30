"""Loops that a run of `balanced` has called: ``python -m tests.signatures`` writes `hybrid.runtime.signatures.FILE`."""

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, cast

from numba import types
from numba.np.numpy_support import as_dtype

from hybrid.runtime.signatures import FILE

ROOT = Path(__file__).parent.parent
PACKAGES = ("flow", "nlm", "hybrid")  # `network.cpu.first_run` compiles the loops of networks
RUN = """
import json, sys
from hybrid.runtime.threads import prepare_libraries
prepare_libraries()
from hybrid.cli import main
from tests.signatures import describe_type
from numba.core.caching import NullCache
from numba.core.dispatcher import Dispatcher

code = main(sys.argv[2:])
for name, module in sorted(sys.modules.items()):
    if name.startswith(tuple(sys.argv[1].split())):
        for attribute, loop in sorted(vars(module).items()):
            # Loops without a cache are compiled within others.
            if isinstance(loop, Dispatcher) and loop.__module__ == name and not isinstance(loop._cache, NullCache):
                for signature in loop.signatures:
                    print(json.dumps([f"{name}.{attribute}", [describe_type(one) for one in signature]]))
sys.exit(code)
"""


def describe_type(type_: Any) -> Any:
    """Return a numba type as JSON, as `hybrid.runtime.signatures.parse_type` reads it; ValueError for other types."""
    if isinstance(type_, types.Array) and type_.mutable and type_.layout in "AC":
        return f"{as_dtype(type_.dtype).name}[{type_.ndim}]{type_.layout.replace('C', '')}"
    if isinstance(type_, types.BaseTuple):
        parts = [describe_type(part) for part in cast(Any, type_)]
        named = getattr(type_, "instance_class", None)
        return parts if named is None else {f"{named.__module__}.{named.__qualname__}": parts}
    if isinstance(type_, types.Number | types.Boolean):
        return as_dtype(type_).name
    raise ValueError(f"{type_} has no short form, expected a scalar, an array that can be written to, or a tuple")


def called_loops(folder: Path) -> list[tuple[str, Any]]:
    """Name and arguments of each loop called for the bundled shot, and for one in which every stage runs."""
    script = ROOT / "benchmarks" / "bench_shot.py"
    words = [sys.executable, str(script), "--write", str(folder), "--shots", "busy", "--frames", "3", "--scale", "1"]
    subprocess.run(words, check=True, capture_output=True)
    called: dict[str, list[Any]] = {}
    for index, shot in enumerate((ROOT / "examples" / "shot" / "noisy.####.exr", folder / "busy" / "busy.####.exr")):
        words = ["denoise", str(shot), "-o", str(folder / f"out{index}"), "--preset", "balanced"]
        words = [sys.executable, "-c", RUN, " ".join(PACKAGES), *words]
        done = subprocess.run(words, cwd=ROOT, check=True, capture_output=True, text=True)
        for line in done.stdout.splitlines():
            name, arguments = json.loads(line)
            if arguments not in called.setdefault(name, []):
                called[name].append(arguments)
    return [(name, arguments) for name in sorted(called) for arguments in called[name]]


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as made:
        loops = called_loops(Path(made))
    assert len(loops) == len(dict(loops)), "a loop is compiled for several types, expected one signature of each"
    rows = ",\n".join(f"{json.dumps(name)}: {json.dumps(arguments)}" for name, arguments in loops)
    FILE.write_text(f"{{\n{rows}\n}}\n", encoding="utf-8")
