#!/usr/bin/env python3
"""Compares what dpm reads of mesh files and skies with what other programs read of them.

    cargo build -p dpm-scene --features exr --example load_all
    tests/peers/files/run.py [--work DIR] [--out docs/lab/FILES.md] [--more DIR]

Packages alone are fetched: trimesh, numpy-stl, OpenEXR and OpenCV from PyPI, three from npm. They contain hardly any files, so
the corpus is what they write: shapes with colours of vertices, of faces and without, in every form that they have, and each of
these again as other systems and other programs would leave it (line ends, byte-order marks, trailing bytes, far coordinates,
wrong endings). `--more` adds the files of a folder. Exit code 1: a file that both peers open is not opened, or read otherwise.
"""

import argparse
import hashlib
import json
import os
import pathlib
import subprocess
import sys

ROOT = pathlib.Path(__file__).resolve().parents[3]
HERE = pathlib.Path(__file__).resolve().parent
PACKAGES = ["trimesh", "numpy", "numpy-stl", "OpenEXR", "opencv-python-headless", "scipy", "pillow"]
MESHES = {".obj", ".ply", ".stl", ".glb", ".gltf"}
SKIES = {".exr", ".hdr"}
LARGEST = 20 << 20


def prepare(work):
    """A folder with the packages; returns its Python."""
    python = work / "venv/bin/python"
    if not python.exists():
        subprocess.run([sys.executable, "-m", "venv", work / "venv"], check=True)
        subprocess.run([work / "venv/bin/pip", "-q", "install", *PACKAGES], check=True)
    if not (work / "node_modules/three").exists():
        subprocess.run(["npm", "install", "--silent", "--prefix", work, "three"], check=True)
    return python


def write_meshes(folder):
    """Shapes as trimesh and numpy-stl write them."""
    import numpy as np
    import trimesh
    from stl import Mode, mesh as stl_mesh

    rng = np.random.default_rng(53)
    shapes = {
        "box": trimesh.creation.box((0.4, 0.3, 0.2)),
        "ball": trimesh.creation.icosphere(subdivisions=3, radius=0.25),
        "capsule": trimesh.creation.capsule(0.3, 0.1),
        "ring": trimesh.creation.torus(0.3, 0.1),
        "cone": trimesh.creation.cone(0.2, 0.5),
        "tube": trimesh.creation.annulus(0.1, 0.2, 0.3),
    }
    for name, shape in shapes.items():
        painted = shape.copy()
        painted.visual = trimesh.visual.ColorVisuals(
            painted, vertex_colors=rng.integers(0, 255, (len(shape.vertices), 4), dtype=np.uint8) | [0, 0, 0, 255]
        )
        tiled = shape.copy()
        tiled.visual = trimesh.visual.ColorVisuals(
            tiled, face_colors=rng.integers(0, 255, (len(shape.faces), 4), dtype=np.uint8) | [0, 0, 0, 255]
        )
        for kind, one in (("plain", shape), ("vertices", painted), ("faces", tiled)):
            own = folder / f"trimesh-{kind}"
            own.mkdir(parents=True, exist_ok=True)
            for ending in ("obj", "ply", "stl", "glb"):
                if kind == "faces" and ending != "ply":
                    continue
                one.export(own / f"{name}.{ending}")
            one.export(own / f"{name}-text.ply", encoding="ascii")
            (own / f"{name}-text.stl").write_text(trimesh.exchange.stl.export_stl_ascii(one))
        data = np.zeros(len(shape.faces), dtype=stl_mesh.Mesh.dtype)
        data["vectors"] = shape.triangles
        own = folder / "numpy-stl"
        own.mkdir(parents=True, exist_ok=True)
        stl_mesh.Mesh(data).save(str(own / f"{name}.stl"), mode=Mode.BINARY)
        stl_mesh.Mesh(data).save(str(own / f"{name}-text.stl"), mode=Mode.ASCII)


def vary(folder):
    """The same files as other systems and programs leave them."""
    for path in sorted(p for p in folder.rglob("*") if p.suffix in MESHES and "variant" not in str(p)):
        bytes_ = path.read_bytes()
        is_text = path.suffix == ".obj" or bytes_.startswith(b"solid") or b"format ascii" in bytes_[:200]
        made = {}
        if is_text:
            made["crlf"] = bytes_.replace(b"\r\n", b"\n").replace(b"\n", b"\r\n")
            if path.suffix != ".ply":
                made["bom"] = b"\xef\xbb\xbf" + bytes_
            made["blanks"] = bytes_.replace(b"\n", b" \n")
        elif path.suffix in (".stl", ".glb"):
            made["trailing"] = bytes_ + b"\0" * 64
        for kind, content in made.items():
            own = folder / f"variant-{kind}"
            own.mkdir(exist_ok=True)
            (own / f"{path.parent.name}-{path.name}").write_bytes(content)


def write_skies(folder):
    """Skies as OpenEXR and OpenCV write them."""
    import numpy as np
    import OpenEXR

    os.environ["OPENCV_IO_ENABLE_OPENEXR"] = "1"
    import cv2

    rng = np.random.default_rng(54)
    light = rng.random((32, 64, 3), dtype=np.float32) * 4
    own = folder / "OpenEXR"
    own.mkdir(parents=True, exist_ok=True)
    kinds = {"NO": OpenEXR.NO_COMPRESSION, "RLE": OpenEXR.RLE_COMPRESSION, "ZIPS": OpenEXR.ZIPS_COMPRESSION,
             "ZIP": OpenEXR.ZIP_COMPRESSION, "PIZ": OpenEXR.PIZ_COMPRESSION, "PXR24": OpenEXR.PXR24_COMPRESSION,
             "B44": OpenEXR.B44_COMPRESSION}
    for name, compression in kinds.items():
        header = {"compression": compression, "type": OpenEXR.scanlineimage}
        for depth, data in (("half", light.astype(np.float16)), ("float", light)):
            OpenEXR.File(header, {"RGB": data}).write(str(own / f"{name}-{depth}.exr"))
    channels = {name: light[:, :, i].copy() for i, name in enumerate(("sky.R", "sky.G", "sky.B"))}
    channels["depth.Z"] = light[:, :, 0].copy()
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, channels).write(
        str(own / "layers.exr"))
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage},
                 {"Y": light[:, :, 0].copy()}).write(str(own / "grey.exr"))
    own = folder / "OpenCV"
    own.mkdir(parents=True, exist_ok=True)
    for ending in ("hdr", "exr"):
        try:
            cv2.imwrite(str(own / f"light.{ending}"), light[:, :, ::-1])
        except cv2.error as e:
            print(f"OpenCV writes no .{ending}: {e.err}", file=sys.stderr)


def trimesh_reads(path):
    import numpy as np
    import trimesh

    try:
        scene = trimesh.load(path, process=False)
        scene = scene if isinstance(scene, trimesh.Scene) else trimesh.Scene(scene)
        meshes = [m for m in scene.dump() if isinstance(m, trimesh.Trimesh) and len(m.faces)]
        if not meshes:
            return {"refused": "no triangles"}
        low = np.min([m.bounds[0] for m in meshes], axis=0)
        high = np.max([m.bounds[1] for m in meshes], axis=0)
        colours = None
        if all(m.visual.kind in ("vertex", "face") for m in meshes):
            colours = [view_colour(meshes, view) for view in range(8)]
        count = int(sum(len(m.faces) for m in meshes))
        return {"triangles": count, "sides": (high - low).tolist(), "colours": colours}
    except Exception as e:  # any refusal of another program is one
        return {"refused": f"{type(e).__name__}: {e}"[:200]}


def view_colour(meshes, view):
    """As `colour` of the example `load_all`."""
    import numpy as np

    towards = np.array([1.0 if view >> bit & 1 == 0 else -1.0 for bit in range(3)]) / np.sqrt(3)
    total, area = np.zeros(3), 0.0
    for m in meshes:
        t = m.triangles
        seen = np.maximum(0, (0.5 * np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0])) @ towards)
        if m.visual.kind == "face":
            of_face = linear(m.visual.face_colors[:, :3])
        else:
            of_face = linear(m.visual.vertex_colors[:, :3])[m.faces].mean(axis=1)
        total += seen @ of_face
        area += seen.sum()
    return (total / max(area, 1e-30)).tolist()


def linear(codes):
    import numpy as np

    c = codes / 255.0
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def sky_reads(path):
    import numpy as np

    try:
        if path.suffix == ".exr":
            import OpenEXR

            channels = OpenEXR.File(str(path), separate_channels=True).channels()
            pick = lambda c: next((channels[k].pixels for k in channels if k == c or k.endswith("." + c)), None)
            rgb = [pick(c) for c in "RGB"]
            rgb = [pick("Y")] * 3 if rgb[0] is None else rgb
            rgb = np.stack([np.asarray(c, dtype=np.float64) for c in rgb], axis=-1)
        else:
            import cv2

            rgb = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[:, :, ::-1].astype(np.float64)
        return {"width": rgb.shape[1], "height": rgb.shape[0], "mean": rgb.mean(axis=(0, 1)).tolist()}
    except Exception as e:
        return {"refused": f"{type(e).__name__}: {e}"[:200]}


def three_reads(work, paths):
    script = work / "three.mjs"
    script.write_text((HERE / "three.mjs").read_text())
    lines = "\n".join(str(p) for p in paths)
    done = subprocess.run(["node", script], input=lines, capture_output=True, text=True, cwd=work, check=False)
    read = (json.loads(line) for line in done.stdout.splitlines() if line.startswith("{"))
    return {one["file"]: one["read"] for one in read}


def ours_reads(program, paths):
    out = {}
    for i in range(0, len(paths), 64):
        some = [str(p) for p in paths[i : i + 64]]
        done = subprocess.run([program, "--json", *some], capture_output=True, text=True, check=False)
        for line in done.stdout.splitlines():
            one = json.loads(line)
            out[one["file"]] = one["read"]
        for path in some:
            out.setdefault(path, {"refused": f"the program ended with {done.returncode}"})
    return out


def differs(ours, peers):
    """What is read otherwise than by any of the peers that open the file; '' if one agrees."""
    if "refused" in ours:
        return f"refused: {ours['refused']}"
    told = ""
    for peer in peers:
        near = lambda a, b, tolerance: all(abs(x - y) <= tolerance * max(1e-9, abs(x), abs(y)) for x, y in zip(a, b))
        if "mean" in peer:
            same = (ours["width"], ours["height"]) == (peer["width"], peer["height"])
            if same and near(ours["mean"], peer["mean"], 2e-3):
                return ""
            told = f"{ours['width']} x {ours['height']} of {ours['mean']}, not {peer['width']} x {peer['height']} of {peer['mean']}"
            continue
        largest = max(peer["sides"])
        if abs(ours["triangles"] - peer["triangles"]) > 0.002 * peer["triangles"]:
            told = f"{ours['triangles']} triangles, not {peer['triangles']:.0f}"
        elif any(abs(a - b) > 1e-3 * largest for a, b in zip(ours["sides"], peer["sides"])):
            told = f"sides {ours['sides']}, not {peer['sides']}"
        elif peer.get("colours") and any(
            abs(a - b) > 0.02 for x, y in zip(ours["colours"], peer["colours"]) for a, b in zip(x, y)
        ):
            told = f"colours {ours['colours'][0]}, not {peer['colours'][0]}"
        else:
            return ""
    return told


def compare(args):
    work = args.work
    corpus = work / "corpus"
    if not corpus.exists():
        write_meshes(corpus)
        vary(corpus)
        write_skies(corpus)
    roots = [corpus, work / "venv/lib", work / "node_modules", *args.more]
    paths, seen = [], set()
    for root in roots:
        for path in sorted(p for p in root.rglob("*") if p.suffix.lower() in MESHES | SKIES and p.is_file()):
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
            if path.stat().st_size <= LARGEST and digest not in seen:
                seen.add(digest)
                paths.append(path.resolve())
    meshes = [p for p in paths if p.suffix.lower() in MESHES]
    ours = ours_reads(args.program, paths)
    three = three_reads(work, meshes)
    groups, wrong = {}, []
    for path in paths:
        if path.suffix.lower() in MESHES:
            peers = [trimesh_reads(path), three.get(str(path), {"refused": "three.js gave no answer"})]
        else:
            peers = [sky_reads(path)]
        opened = [p for p in peers if "refused" not in p]
        group = groups.setdefault((path.parent.name, path.suffix.lower()), [0, 0, 0, 0])
        group[0] += 1
        group[1] += len(opened) == len(peers)
        group[2] += "refused" not in ours[str(path)]
        told = differs(ours[str(path)], opened) if opened else ""
        if told and len(opened) == len(peers):
            group[3] += 1
            wrong.append(f"{path}: {told}")
    rows = sorted(groups.items(), key=lambda g: (-(g[1][3] / g[1][0]), g[0]))
    table = ["| written by | ending | files | opened by all peers | opened by dpm | of these wrong or refused |",
             "|---|---|---:|---:|---:|---:|"]
    table += [f"| {name} | `{ending}` | {n} | {both} | {own} | {bad} |" for (name, ending), (n, both, own, bad) in rows]
    total = [sum(g[i] for g in groups.values()) for i in range(4)]
    table.append(f"| all | | {total[0]} | {total[1]} | {total[2]} | {total[3]} |")
    text = "\n".join(table) + "\n"
    print(text)
    print("\n".join(wrong))
    if args.out:
        old = args.out.read_text() if args.out.exists() else ""
        begin, end = "<!-- table -->\n", "<!-- end -->\n"
        if begin in old and end in old:
            text = old[: old.index(begin) + len(begin)] + text + old[old.index(end) :]
        args.out.write_text(text)
    sys.exit(1 if wrong else 0)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=pathlib.Path, default=ROOT / "target/peers-files")
    parser.add_argument("--program", type=pathlib.Path, default=ROOT / "target/debug/examples/load_all")
    parser.add_argument("--out", type=pathlib.Path)
    parser.add_argument("--more", type=pathlib.Path, action="append", default=[])
    parser.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    args.work.mkdir(parents=True, exist_ok=True)
    if args.inside:
        return compare(args)
    python = prepare(args.work.resolve())
    sys.exit(subprocess.run([python, __file__, "--inside", *sys.argv[1:]], check=False).returncode)


if __name__ == "__main__":
    main()
