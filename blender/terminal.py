"""The command line ``blender --background FILE --command ravg`` for render farms: exit codes, no tracebacks."""

import argparse
import sys
from collections.abc import Sequence

import bpy

from . import operators

NAME = "ravg"


def run(arguments: Sequence[str]) -> int:
    """Denoise the scene of the open file; return 0, 1 after an error, or 2 for wrong arguments."""
    parser = argparse.ArgumentParser(prog=f"blender --background FILE --command {NAME}", description=__doc__)
    parser.add_argument("--render", action="store_true", help="set up the passes and render the animation first")
    existing = parser.add_mutually_exclusive_group()
    for choice, text in (("keep", "make only the frames that are missing"), ("replace", "make all frames again")):
        existing.add_argument(f"--{choice}", dest="existing", action="store_const", const=choice.upper(), help=text)
    try:
        chosen = parser.parse_args(arguments)
    except SystemExit as end:  # argparse has printed why
        return int(end.code or 0)
    try:
        done = bpy.ops.ravg.denoise(render=chosen.render, existing=chosen.existing or "ASK")
    except RuntimeError as error:
        print(str(error).strip().replace(operators.CHOICE, "--keep or --replace"), file=sys.stderr)
        return 1
    return 0 if done == {"FINISHED"} else 1
