#!/usr/bin/env python3
"""Compares what dpm reads of mesh files and skies with what other programs read of them.

    cargo build -p dpm-scene --features exr --example load_all
    tests/peers/files/run.py [--work DIR] [--out docs/lab/FILES.md] [--more DIR] [--only-more] [--damage N [--seed N]]

Packages alone are fetched: trimesh, numpy-stl, OpenEXR and OpenCV from PyPI, three from npm. They contain hardly any files, so
the corpus is what they write: shapes with colours of vertices, of faces and without, in every form that they have, and each of
these again as other systems and other programs would leave it (line ends, byte-order marks, trailing bytes, far coordinates,
wrong endings). `--more` adds the files of a folder: meshes, skies, pictures, which Pillow reads as well, and calibrations.
`--damage` has dpm alone read so many of all files with bits turned, parts cut off, doubled, overwritten and taken from others.
Exit code 1: a file that all peers open is not opened, or read otherwise; a reader panics, needs more than 30 s, or asks for
more memory at once than 64 MB and sixteen times the file's bytes.
"""

import argparse
import hashlib
import json
import os
import pathlib
import subprocess
import sys
import tempfile

ROOT = pathlib.Path(__file__).resolve().parents[3]
HERE = pathlib.Path(__file__).resolve().parent
PACKAGES = ["trimesh", "numpy", "numpy-stl", "OpenEXR", "opencv-python-headless", "scipy", "pillow", "tifffile"]
MESHES = {".obj", ".ply", ".stl", ".glb", ".gltf"}
SKIES = {".exr", ".hdr"}
PICTURES = {".png", ".jpg", ".jpeg", ".tga", ".tif", ".tiff", ".webp", ".bmp"}
# What dpm alone reads here; `calibrations.py` compares such files with OpenCV.
OTHERS = {".ktx2", ".yml", ".yaml", ".xml", ".json", ".gz", ".zip", ".mpcdi", ".npz"}
LARGEST = 20 << 20
# What a note says where dpm reads a file otherwise than others on purpose; a difference without one of these is silent.
REASONS = ["without area", "it is read with", "missing and black", "cut off there", "play", "left out", "primaries", "no light",
           "sampled anew", "hides", "moved by as much", "is skipped", "in every frame", "is damaged"]


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


def write_pictures(folder):
    """Pictures as Pillow, OpenCV and tifffile write them: most of all TIFF, of which there are the most kinds."""
    import cv2
    import numpy as np
    import tifffile
    from PIL import Image

    rng = np.random.default_rng(55)
    y, x = np.mgrid[0:45, 0:70]
    smooth = np.stack([x * 3, y * 5, 255 - x - y, np.full_like(x, 200)], axis=-1).astype(np.uint8)
    codes = np.where(rng.random((45, 70, 1)) < 0.9, smooth, 255 - smooth).astype(np.uint8)
    rgba = Image.fromarray(codes)
    own = folder / "Pillow"
    own.mkdir(parents=True, exist_ok=True)

    def save(name, mode, **options):
        try:
            (rgba if mode == "RGBA" else rgba.convert("RGB").convert(mode)).save(own / name, **options)
        except (OSError, ValueError, KeyError) as e:
            print(f"Pillow writes no {name}: {e}", file=sys.stderr)

    packings = [None, "packbits", "tiff_lzw", "tiff_adobe_deflate", "jpeg", "zstd", "webp", "group3", "group4", "tiff_ccitt"]
    for packing in packings:
        for mode in ("1", "L", "LA", "P", "RGB", "RGBA", "CMYK", "YCbCr", "I;16", "F"):
            is_fax = packing in ("group3", "group4", "tiff_ccitt")
            if is_fax == (mode == "1") or packing is None:
                save(f"{mode.replace(';', '')}-{packing}.tif", mode, compression=packing)
    for mode in ("1", "L", "P", "RGB", "RGBA"):
        for ending in ("png", "bmp", "tga"):
            save(f"{mode}.{ending}", mode)
        save(f"{mode}-runs.tga", mode, compression="tga_rle")
    for mode in ("L", "RGB", "CMYK"):
        for name, options in (("even", {"subsampling": 0}), ("half", {"subsampling": 2}), ("steps", {"progressive": True})):
            save(f"{mode}-{name}.jpg", mode, quality=95, **options)
    save("loss.webp", "RGBA", quality=95)
    save("same.webp", "RGBA", lossless=True)
    own = folder / "OpenCV"
    own.mkdir(parents=True, exist_ok=True)
    for name, array in (("8", codes), ("16", codes.astype(np.uint16) * 257), ("32", codes[..., :3].astype(np.float32) / 255)):
        for packing in (1, 5, 8, 32773):
            cv2.imwrite(str(own / f"{name}-{packing}.tif"), array, [cv2.IMWRITE_TIFF_COMPRESSION, packing])
    own = folder / "tifffile"
    own.mkdir(parents=True, exist_ok=True)
    for kind in ("u1", "u2", "f2", "f4"):
        array = (codes[..., :3] / 255).astype(kind) if kind[0] == "f" else codes[..., :3].astype(kind) * (257 if kind == "u2" else 1)
        for order in "<>":
            for name, options in (
                ("strips", {"rowsperstrip": 7}), ("tiles", {"tile": (16, 32)}), ("planes", {"planarconfig": "separate"}),
                ("tiles-in-planes", {"planarconfig": "separate", "tile": (16, 16)}), ("big", {"bigtiff": True}),
            ):
                data = np.moveaxis(array, -1, 0) if "planarconfig" in options else array
                label = f"{kind}-{'little' if order == '<' else 'big-end'}-{name}.tif"
                tifffile.imwrite(own / label, data, photometric="rgb", byteorder=order, **options)


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
        if not np.isfinite(high - low).all():
            return {"refused": "coordinates that are no numbers"}
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
        if path.suffix.lower() == ".exr":
            rgb = exr_light(path)
        else:
            import cv2

            rgb = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[:, :, ::-1].astype(np.float64)
        # What is no light: SCENES.md says what dpm makes of it.
        rgb = np.clip(np.nan_to_num(rgb, nan=0.0, posinf=65504.0, neginf=0.0), 0.0, None)
        return {"width": rgb.shape[1], "height": rgb.shape[0], "mean": rgb.mean(axis=(0, 1)).tolist()}
    except Exception as e:
        return {"refused": f"{type(e).__name__}: {e}"[:200]}


def exr_light(path):
    """Red, green and blue of the layer with light, in the display window; black where nothing is stored."""
    import numpy as np
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        for part in file.parts:
            header, channels = part.header, part.channels
            layers = sorted({name.rpartition(".")[0] for name in channels if name.rpartition(".")[2] in "RY"})
            if layers:
                break
        prefix = layers[0] + "." if layers[0] else ""
        if prefix + "RY" in channels or "chromaticities" in header:
            raise ValueError("chroma and other primaries are not converted here")
        rgb = [channels.get(prefix + c, channels.get(prefix + "Y")) for c in "RGB"]
        rgb = np.stack([np.asarray(c.pixels, dtype=np.float64) for c in rgb], axis=-1)
        (left, top), (right, bottom) = header["displayWindow"]
        (x0, y0), (x1, y1) = header["dataWindow"]
        out = np.zeros((bottom - top + 1, right - left + 1, 3))
        l, t, r, b = max(left, x0), max(top, y0), min(right, x1) + 1, min(bottom, y1) + 1
        if l < r and t < b:
            out[t - top : b - top, l - left : r - left] = rgb[t - y0 : b - y0, l - x0 : r - x0]
        return out


def picture_reads(path):
    """Red, green, blue and alpha of all texels, as Pillow reads them."""
    import numpy as np
    from PIL import Image

    try:
        with Image.open(path) as picture:
            if picture.mode.startswith("I") or picture.mode == "F":
                # Pillow cuts numbers of more than eight bits off at 255.
                numbers = np.asarray(picture, dtype=np.float64)
                of_one = {"I;16": 1 / 257, "F": 255.0}
                grey = np.clip(numbers * next((f for mode, f in of_one.items() if picture.mode.startswith(mode)), 1 / 257), 0, 255)
                texels = np.dstack([grey] * 3 + [np.full(grey.shape, 255.0)])
            else:
                texels = np.asarray(picture.convert("RGBA"), dtype=np.float64)
        return {"texels": texels}
    except Exception as e:
        return {"refused": f"{type(e).__name__}: {e}"[:200]}


def opencv_reads(path):
    """The same as OpenCV reads it, which is asked where Pillow differs: Pillow takes 16 bits in planes for 8, for one."""
    import cv2
    import numpy as np

    try:
        texels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        scale = {"uint8": 1.0, "uint16": 1 / 257, "float32": 255.0, "float64": 255.0}[str(texels.dtype)]
        texels = np.clip(np.atleast_3d(texels).astype(np.float64) * scale, 0, 255)
        if texels.shape[2] == 1:
            texels = texels.repeat(3, axis=2)
        alpha = texels[..., 3:] if texels.shape[2] == 4 else np.full((*texels.shape[:2], 1), 255.0)
        return {"texels": np.concatenate([texels[..., 2::-1], alpha], axis=2)}
    except Exception as e:
        return {"refused": f"{type(e).__name__}: {e}"[:200]}


def tifffile_reads(path):
    """Numbers of RGB as tifffile gives them; it unpacks only what needs no other package."""
    import numpy as np
    import tifffile

    try:
        with tifffile.TiffFile(path) as file:
            page = file.pages[0]
            if page.photometric != tifffile.PHOTOMETRIC.RGB or page.samplesperpixel != 3:
                return {"refused": "other colours"}
            texels = page.asarray()
            texels = np.moveaxis(texels, 0, -1) if page.planarconfig == 2 else texels
            full = np.iinfo(texels.dtype).max if texels.dtype.kind == "u" else 1.0
            codes = np.clip(texels.astype(np.float64) / full, 0, 1) * 255
        return {"texels": np.concatenate([codes, np.full((*codes.shape[:2], 1), 255.0)], axis=2)}
    except Exception as e:
        return {"refused": f"{type(e).__name__}: {e}"[:200]}


def picture_differs(ours, file, path, pillow):
    """What of a picture is read otherwise than by Pillow, OpenCV and tifffile: '' if one agrees."""
    if "refused" in pillow or "refused" in ours:
        return ""
    told = texels_differ(ours, file, pillow["texels"])
    for reads in (opencv_reads, tifffile_reads):
        other = reads(path) if told else {"refused": ""}
        told = told if "refused" in other else told and texels_differ(ours, file, other["texels"]) and told
    return told


def texels_differ(ours, file, theirs):
    """'' if every channel is off by at most a code in the mean of all texels."""
    import numpy as np

    size = (ours["height"], ours["width"])
    if size != theirs.shape[:2]:
        return f"{size[1]} x {size[0]}, not {theirs.shape[1]} x {theirs.shape[0]}"
    texels = np.fromfile(file, np.uint8).reshape(theirs.shape).astype(np.float64)
    off = np.abs(texels - theirs)
    # What is not there has no colour.
    off[..., :3][(texels[..., 3] == 0) & (theirs[..., 3] == 0)] = 0
    off = off.mean(axis=(0, 1))
    return "" if off.max() <= 1.0 else f"texels off by {off.round(2).tolist()} codes in the mean"


def three_reads(work, paths):
    script = work / "three.mjs"
    script.write_text((HERE / "three.mjs").read_text())
    lines = "\n".join(str(p) for p in paths)
    done = subprocess.run(["node", script], input=lines, capture_output=True, text=True, cwd=work, check=False)
    read = (json.loads(line) for line in done.stdout.splitlines() if line.startswith("{"))
    return {one["file"]: one["read"] for one in read}


def ours_reads(program, paths, is_compared=False):
    """What dpm reads of each file, with what the reading costs, and how its pictures differ from those of Pillow."""
    out = {}
    for i in range(0, len(paths), 64):
        waiting = paths[i : i + 64]
        while waiting:
            with tempfile.TemporaryDirectory() as folder:
                texels = ["--texels", folder] if is_compared else []
                command = [program, "--json", *texels, *map(str, waiting)]
                done = subprocess.run(command, capture_output=True, text=True, check=False)
                read = [json.loads(line) for line in done.stdout.splitlines()]
                for place, (path, one) in enumerate(zip(waiting, read)):
                    if is_compared and path.suffix.lower() in PICTURES:
                        peer = picture_reads(path)
                        one["is_peer_open"] = "refused" not in peer
                        one["other"] = picture_differs(one["read"], pathlib.Path(folder) / str(place), path, peer)
                    out[str(path)] = one
            waiting = waiting[len(read) :]
            if waiting:
                told = {"refused": f"the program ended with {done.returncode}: {done.stderr[-300:]}"}
                out[str(waiting[0])] = {"ms": 0, "piece": 0, "at_most": 0, "read": told, "crashed": True}
                waiting = waiting[1:]
    return out


def faults(ours, path):
    """What no file may do to a reader."""
    told = ours["read"].get("refused", "")
    # A program that ends, a panic that was caught, and a load that was given up.
    if ours.get("crashed") or "a defect of this program" in told or "took longer than" in told or ours["ms"] > 30_000:
        yield f"{path}: {told or ours['ms']}"
    allowed = 64_000_000 + 16 * sum(p.stat().st_size for p in belonging(path))
    if ours["piece"] > allowed:
        yield f"{path}: {ours['piece']} bytes at once, {allowed} are allowed"


def belonging(path):
    """The file, and those of its folders that it may name."""
    if path.suffix.lower() not in (".gltf", ".obj"):
        return [path]
    return [path, *(p for p in path.parent.rglob("*") if p.is_file() and p.suffix.lower() not in (".gltf", ".obj", ".glb"))]


def damage(args, paths):
    """Reads files after seeded damage; the fault of each that does what none may."""
    import random

    chance = random.Random(args.seed)
    of_ending = {}
    for path in paths:
        of_ending.setdefault(path.suffix.lower(), []).append(path)
    made = []
    for number in range(args.damage):
        # As many of each ending.
        path = chance.choice(of_ending[chance.choice(sorted(of_ending))])
        whole = bytearray(path.read_bytes())
        for _ in range(chance.choice((1, 1, 2, 8))):
            kind, at = chance.randrange(6), chance.randrange(max(1, min(len(whole), chance.choice((200, 4096, 1 << 30)))))
            if kind == 0 and whole:
                whole[at] ^= 1 << chance.randrange(8)
            elif kind == 1 and whole:
                whole[at : at + 4] = chance.choice((b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\0\0\0\0", b"9999"))
            elif kind == 2:
                del whole[chance.randrange(at, len(whole) + 1) :]
            elif kind == 3:
                del whole[at : at + chance.randrange(1, 200)]
            elif kind == 4:
                whole[at:at] = whole[at : at + chance.randrange(1, 200)] * chance.randrange(1, 5)
            else:
                other = chance.choice(paths).read_bytes()
                begin = chance.randrange(max(1, len(other)))
                whole[at : at + 4096] = other[begin : begin + chance.randrange(1, 4096)]
        # Beside its original, since it may name the files there.
        made.append(path.with_name(f"damaged-{number}{path.suffix}"))
        made[-1].write_bytes(whole)
    ours = ours_reads(args.program, made)
    found = [told for path in made for told in faults(ours[str(path)], path)]
    opened = sum("refused" not in one["read"] for one in ours.values())
    print(f"{len(made)} damaged files: {opened} opened, {len(found)} faults; at most {max(o['ms'] for o in ours.values())} ms, "
          f"{max(o['piece'] for o in ours.values()) >> 20} MiB at once and {max(o['at_most'] for o in ours.values()) >> 20} MiB in all")
    print("\n".join(found))
    keep = {told.split(": ")[0] for told in found}
    for path in made:
        if str(path) not in keep:
            path.unlink()
    return found


def differs(ours, peers):
    """What is read otherwise than by any of the peers that open the file; '' if one agrees."""
    if "refused" in ours:
        return f"refused: {ours['refused']}"
    told = ""
    for peer in peers:
        if "other" in peer:
            return peer["other"]
        if "mean" in peer:
            same = (ours["width"], ours["height"]) == (peer["width"], peer["height"])
            if same and all(abs(x - y) <= 2e-3 * max(abs(x), abs(y)) for x, y in zip(ours["mean"], peer["mean"])):
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


def corpus_files(args):
    """The files to read, each content once, and the group of each."""
    own = args.work / "corpus"
    if not own.exists() and not args.only_more:
        write_meshes(own)
        vary(own)
        write_skies(own)
        write_pictures(own)
    packages = [own, args.work / "venv/lib", args.work / "node_modules"]
    paths, seen = {}, set()
    for root in [] if args.only_more else packages:
        for path in sorted(p for p in root.rglob("*") if p.suffix.lower() in MESHES | SKIES and p.is_file()):
            note(paths, seen, path, path.parent.name)
    if not args.only_more:
        for path in sorted(p for p in own.rglob("*") if p.suffix.lower() in PICTURES):
            note(paths, seen, path, path.parent.name)
    for root in args.more:
        endings = MESHES | SKIES | PICTURES | OTHERS
        for path in sorted(p for p in root.rglob("*") if p.suffix.lower() in endings and p.is_file()):
            note(paths, seen, path, "others")
    return paths


def note(paths, seen, path, group):
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    if path.stat().st_size <= LARGEST and digest not in seen:
        seen.add(digest)
        paths[path.resolve()] = group


def compare(args):
    paths = corpus_files(args)
    if args.damage:
        sys.exit(1 if damage(args, list(paths)) else 0)
    ours = ours_reads(args.program, list(paths), is_compared=True)
    meshes = [p for p in paths if p.suffix.lower() in MESHES]
    three = three_reads(args.work, meshes)
    groups, wrong = {}, []
    for path, name in paths.items():
        ending, one = path.suffix.lower(), ours[str(path)]
        if ending in MESHES:
            peers = [trimesh_reads(path), three.get(str(path), {"refused": "three.js gave no answer"})]
        elif ending in OTHERS:
            peers = [{"refused": "nobody was asked"}]
        elif ending in SKIES:
            peers = [sky_reads(path)]
        else:
            peers = [{"other": one.get("other", "")} if one.get("is_peer_open", "crashed" in one) else {"refused": ""}]
        opened = [p for p in peers if "refused" not in p]
        group = groups.setdefault((name, ending), [0] * 8)
        told = differs(one["read"], opened) if opened else ""
        is_both = len(opened) == len(peers)
        wrong += [f"{path}: {told}; notes: {one['read'].get('warnings')}"] if told and is_both else []
        found = list(faults(one, path))
        wrong += found
        refused = "refused" in one["read"]
        is_told = refused or any(reason in note for note in one["read"].get("warnings", []) for reason in REASONS)
        adds = (1, is_both, not refused, is_both and refused, is_both and told != "", is_both and told != "" and not is_told, len(found) > 0)
        for i, add in enumerate(adds):
            group[i] += add
        group[7] = max(group[7], one["piece"])
    table = report(groups)
    print(table)
    print("\n".join(wrong))
    if args.out:
        write_out(args.out, table)
    sys.exit(1 if wrong else 0)


def report(groups):
    rows = sorted(groups.items(), key=lambda g: (-(g[1][5] / g[1][0]), -(g[1][4] / g[1][0]), g[0]))
    total = [sum(g[i] for g in groups.values()) for i in range(7)] + [max(g[7] for g in groups.values())]
    cells = [(name, f"`{ending}`", row) for (name, ending), row in rows] + [("all", "", total)]
    table = ["| written by | ending | files | opened by all peers | opened by dpm | refused alone | refused or other | of these silent "
             "| faults | at once, MiB |", "|---|---|---:|---:|---:|---:|---:|---:|---:|---:|"]
    table += [f"| {name} | {ending} | {' | '.join(map(str, row[:7]))} | {row[7] / (1 << 20):.1f} |" for name, ending, row in cells]
    return "\n".join(table) + "\n"


def write_out(out, text):
    """Puts the table where the former one stands."""
    old = out.read_text() if out.exists() else ""
    begin, end = "<!-- table -->\n", "<!-- end -->\n"
    if begin in old and end in old:
        text = old[: old.index(begin) + len(begin)] + text + old[old.index(end) :]
    out.write_text(text)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=pathlib.Path, default=ROOT / "target/peers-files")
    parser.add_argument("--program", type=pathlib.Path, default=ROOT / "target/debug/examples/load_all")
    parser.add_argument("--out", type=pathlib.Path)
    parser.add_argument("--more", type=pathlib.Path, action="append", default=[])
    parser.add_argument("--only-more", action="store_true", help="leave out what the packages write and have")
    parser.add_argument("--damage", type=int, default=0, help="read so many damaged files")
    parser.add_argument("--seed", type=int, default=53)
    parser.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    args.work.mkdir(parents=True, exist_ok=True)
    if args.inside:
        return compare(args)
    python = prepare(args.work.resolve())
    sys.exit(subprocess.run([python, __file__, "--inside", *sys.argv[1:]], check=False).returncode)


if __name__ == "__main__":
    main()
