#!/usr/bin/env python3
"""Is a rig that needs nothing optional as fast as the same program with that code deleted? Instructions of both, shader by shader.

    tests/peers/stripped_shaders.py [--most 0.5]

Specialised: the shader with everything in it, its constants set as for a rig that needs nothing (a diffuse scene in even light, method `full`),
then folded as a driver does. Deleted: the sources with each of those constants written out, so that the compiler never emits the
code. Needs glslc, spirv-opt and spirv-dis. Exit code 1 when the specialised shader has more than --most percent instructions too many.
"""
import argparse
import pathlib
import re
import subprocess
import sys
import tempfile

GLSL = pathlib.Path(__file__).resolve().parents[2] / "shaders/glsl"
# Values for a rig that needs nothing. The environment is constant (1), because something must light the scene.
LEAN = {"HAS_TEXTURES": "false", "HAS_NORMAL_MAPS": "false", "HAS_ALPHA_MASK": "false", "HAS_TRANSMISSION": "false", "HAS_SPECULAR": "false",
        "HAS_EMISSIVE": "false", "HAS_PUNCTUAL": "false", "ENVIRONMENT_KIND": "1", "HAS_CLAMP": "false", "HAS_DIFFUSE": "true", "SAMPLER": "0",
        "HAS_GUIDES": "true", "HAS_DEMODULATION": "false", "HAS_FILTER": "false", "HAS_CLEARCOAT": "false",
        "HAS_SPECULAR_COLOR": "false", "HAS_ANISOTROPY": "false", "HAS_SHEEN": "false", "HAS_ABSORPTION": "false", "HAS_ALPHA_BLEND": "false",
        "HAS_IRIDESCENCE": "false", "HAS_DIFFUSE_TRANSMISSION": "false", "HAS_DISPERSION": "false"}
SHADERS = [("trace", ["-DTEXEL_TABLES"]), ("trace", []), ("primary", ["-DTEXEL_TABLES"]), ("primary", []),
           ("reproject_point", []), ("accumulate_samples", []), ("spatial_regression", []), ("compensate", [])]
CONSTANT = re.compile(r"layout\(constant_id = (\d+)\) const (\w+) (\w+) = \w+;")


def delete(match):
    if match[3] not in LEAN:
        return match[0]
    return f"const {match[2]} {match[3]} = {LEAN[match[3]]}{'u' if match[2] == 'uint' else ''};"


def instructions(module):
    """Instructions of the functions: what runs, without declarations."""
    text = subprocess.run(["spirv-dis", "--no-header", module], capture_output=True, text=True, check=True).stdout
    return len(text[text.index("OpFunction "):].splitlines())


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--most", type=float, default=0.5)
    args = parser.parse_args()
    worst = 0.0
    with tempfile.TemporaryDirectory() as folder:
        stripped = pathlib.Path(folder) / "glsl"
        stripped.mkdir()
        for source in GLSL.iterdir():
            (stripped / source.name).write_text(CONSTANT.sub(delete, source.read_text()))
        module = lambda name: str(pathlib.Path(folder) / name)
        ids = {name: number for number, _, name in CONSTANT.findall((GLSL / "generated.glsl").read_text())}
        values = " ".join(f"{ids[name]}:{value}" for name, value in LEAN.items())
        print("| shader | all in | specialised | deleted |\n|---|---:|---:|---:|")
        for name, defines in SHADERS:
            for glsl, out in ((GLSL, "all.spv"), (stripped, "deleted.spv")):
                subprocess.run(["glslc", "--target-env=vulkan1.1", "-O", "-I", str(glsl), *defines, str(glsl / f"{name}.comp"),
                                "-o", module(out)], check=True)
            subprocess.run(["spirv-opt", f"--set-spec-const-default-value={values}", "--freeze-spec-const",
                            "--fold-spec-const-op-composite", "-O", module("all.spv"), "-o", module("lean.spv")], check=True)
            subprocess.run(["spirv-opt", "-O", module("deleted.spv"), "-o", module("deleted.spv")], check=True)
            everything, lean, deleted = (instructions(module(m)) for m in ("all.spv", "lean.spv", "deleted.spv"))
            print(f"| {name}{' (texel)' if defines else ''} | {everything} | {lean} | {deleted} |")
            worst = max(worst, 100.0 * (lean / deleted - 1.0))
    print(f"at most {worst:.2f} % more than with the code deleted", file=sys.stderr)
    return 1 if worst > args.most else 0


if __name__ == "__main__":
    sys.exit(main())
