#!/usr/bin/env python3
"""Radiance of `dpm snapshot` beside that of Mitsuba 3, for the lobes of materials that both models have: one ball a material, under an even
sky, a bright ceiling, and where light passes the ball, before a board of squares.

    pip install mitsuba numpy
    tests/peers/mitsuba_lobes.py [--dpm target/release/dpm] [--spp 4096] [--raster 64x64] [NAME...]

Eye and projector stand at one place, so that both programs draw one view. Prints the mean of both over the inner four fifths of the ball's disk,
with the standard error of their difference, in per cent of the mean.
"""
import argparse
import importlib.util
import json
import math
import pathlib
import subprocess
import tempfile

import numpy as np

HERE = pathlib.Path(__file__).resolve().parent
RADIUS, DISTANCE, FOV = 0.03, 0.4, 14.0
SKY, CEILING = 0.5, 8.0


def gallery():
    spec = importlib.util.spec_from_file_location("gallery", HERE.parent / "assets/gallery/make.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.AROUND, module.UP, module.RADIUS = 512, 256, RADIUS
    return module


def metal(color, roughness, **extensions):
    return material(color, 1.0, roughness, **extensions)


def material(color, metallic, roughness, **extensions):
    m = {"pbrMetallicRoughness": {"baseColorFactor": [*color, 1.0], "metallicFactor": metallic, "roughnessFactor": roughness}}
    if extensions:
        m["extensions"] = {f"KHR_materials_{k}": v for k, v in extensions.items()}
    return m


def rgb(*values):
    return {"type": "rgb", "value": list(values)}


# What `principled` makes of anisotropy: alpha_x = r^2 / aspect, alpha_y = r^2 aspect, aspect = sqrt(1 - 0.9 a). In glTF alpha_b = r^2, and
# alpha_t = alpha_b + (1 - alpha_b) a^2.
def brushed(roughness, anisotropy, rotation=0.0):
    aspect = math.sqrt(1.0 - 0.9 * anisotropy)
    wide, narrow = roughness**2 / aspect, roughness**2 * aspect
    strength = math.sqrt((wide - narrow) / (1.0 - narrow))
    ours = metal((0.9, 0.6, 0.3), math.sqrt(narrow), anisotropy={"anisotropyStrength": strength, "anisotropyRotation": rotation})
    theirs = {"type": "principled", "base_color": rgb(0.9, 0.6, 0.3), "metallic": 1.0, "roughness": roughness, "anisotropic": anisotropy}
    return ours, theirs


def brushed_conductor(alpha_t, alpha_b):
    strength = math.sqrt((alpha_t - alpha_b) / (1.0 - alpha_b))
    ours = metal((1, 1, 1), math.sqrt(alpha_b), anisotropy={"anisotropyStrength": strength})
    theirs = {"type": "roughconductor", "distribution": "ggx", "material": "none", "alpha_u": alpha_t, "alpha_v": alpha_b}
    return ours, theirs


# A coat over white is Mitsuba's plastic with a white base: what leaves the base is spread as what enters it, in both. Over another colour plastic
# counts the light that returns to the base, and glTF's coat does not. `roughplastic` over white returns 0.79 of an even sky at alpha 0.2, so it is
# asked over black only. `principled` has a coat of another distribution, with longer tails.
def coated(color, alpha):
    ours = material((color,) * 3, 0.0, 1.0, ior={"ior": 1.0}, clearcoat={"clearcoatFactor": 1.0, "clearcoatRoughnessFactor": math.sqrt(alpha)})
    theirs = {"type": "roughplastic" if alpha > 0.0 else "plastic", "diffuse_reflectance": rgb(*(color,) * 3), "int_ior": 1.5, "ext_ior": 1.0}
    if alpha > 0.0:
        theirs |= {"alpha": alpha, "distribution": "ggx"}
    return ours, theirs


def absorbing(index, color, distance):
    sigma = [-math.log(c) / distance for c in color]
    ours = material((1, 1, 1), 0.0, 0.0, transmission={"transmissionFactor": 1.0}, ior={"ior": index},
                    volume={"thicknessFactor": RADIUS, "attenuationColor": list(color), "attenuationDistance": distance})
    medium = {"type": "homogeneous", "albedo": 0.0, "sigma_t": rgb(*(v / max(sigma) for v in sigma)), "scale": max(sigma)}
    return ours, {"type": "dielectric", "int_ior": index, "ext_ior": 1.0}, medium


CASES = {
    "plain": lambda: (material((0.6, 0.02, 0.02), 0.0, 1.0, ior={"ior": 1.0}), {"type": "diffuse", "reflectance": rgb(0.6, 0.02, 0.02)}),
    "conductor-round": lambda: brushed_conductor(0.2, 0.1999),
    "conductor-brushed": lambda: brushed_conductor(0.4, 0.05),
    "conductor-far-brushed": lambda: brushed_conductor(0.8, 0.01),
    "principled-brushed": lambda: brushed(0.4, 0.8),
    "principled-round": lambda: brushed(0.4, 0.01),
    "coat-over-black": lambda: coated(0.0, 0.0),
    "coat-over-white": lambda: coated(1.0, 0.0),
    "rough-coat-over-black": lambda: coated(0.0, 0.2),
    "glass": lambda: absorbing(1.5, (0.999999,) * 3, 1.0),
    "green-glass": lambda: absorbing(1.5, (0.2, 0.9, 0.3), 0.03),
    "dark-glass": lambda: absorbing(1.33, (0.5, 0.2, 0.05), 0.02),
}


def ceiling(size, height):
    positions = [(-size, height, -size), (size, height, -size), (size, height, size), (-size, height, size)]
    return positions, [(0, -1, 0)] * 4, [(1, 0, 0, 1)] * 4, [(0, 0), (1, 0), (1, 1), (0, 1)], [(0, 1, 2), (0, 2, 3)]


def write_scene(path, parts):
    """glTF as text: one node a shape."""
    import base64
    import struct
    blob, views, accessors, meshes, nodes, looks = bytearray(), [], [], [], [], []

    def accessor(values, kind, component, code):
        views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": len(values) * len(values[0]) * struct.calcsize(code)})
        for value in values:
            blob.extend(struct.pack("<" + code * len(value), *value))
        count = len(values) * (len(values[0]) if kind == "SCALAR" else 1)
        entry = {"bufferView": len(views) - 1, "componentType": component, "count": count, "type": kind}
        if kind == "VEC3":
            entry["min"] = [min(v[c] for v in values) for c in range(3)]
            entry["max"] = [max(v[c] for v in values) for c in range(3)]
        accessors.append(entry)
        return len(accessors) - 1

    for name, (positions, normals, tangents, uvs, indices), look in parts:
        places = {"POSITION": accessor(positions, "VEC3", 5126, "f"), "NORMAL": accessor(normals, "VEC3", 5126, "f"),
                  "TANGENT": accessor(tangents, "VEC4", 5126, "f"), "TEXCOORD_0": accessor(uvs, "VEC2", 5126, "f")}
        meshes.append({"primitives": [{"attributes": places, "indices": accessor(indices, "SCALAR", 5125, "I"), "material": len(looks)}]})
        nodes.append({"name": name, "mesh": len(meshes) - 1})
        looks.append(look)
    document = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": list(range(len(nodes)))}], "nodes": nodes, "meshes": meshes,
                "materials": looks, "accessors": accessors, "bufferViews": views,
                "extensionsUsed": sorted({e for m in looks for e in m.get("extensions", {})}),
                "buffers": [{"byteLength": len(blob), "uri": "data:application/octet-stream;base64," + base64.b64encode(bytes(blob)).decode()}]}
    path.write_text(json.dumps(document))


def shapes(ours):
    g = gallery()
    lamp = {"doubleSided": True, "emissiveFactor": [1, 1, 1], "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": CEILING}},
            "pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1], "metallicFactor": 1, "roughnessFactor": 1}}
    return [("ball", g.ball(), ours), ("ceiling", ceiling(0.1, 0.15), lamp)]


def read_pfm(path):
    with open(path, "rb") as f:
        kind, size, scale = f.readline().strip(), f.readline().split(), float(f.readline())
        width, height = map(int, size)
        data = np.frombuffer(f.read(), "<f4" if scale < 0 else ">f4").reshape(height, width, 3 if kind == b"PF" else 1)
    return data[::-1]


def dpm_pictures(args, parts, folder):
    scene = folder / "scene.gltf"
    write_scene(scene, parts)
    pictures = []
    per_run = min(args.spp, 256)
    for seed in range(max(args.spp // per_run, 1)):
        out = folder / f"{seed}"
        command = [args.dpm, "snapshot", str(scene), "--raster", args.raster, "--what", "radiance", "--frame", "0", "--out", str(out)]
        for s in [f"scene.environment={{kind=\"constant\",radiance=[{SKY},{SKY},{SKY}]}}", f"projector.position=[0.0,0.0,{DISTANCE}]",
                  "projector.look_at=[0.0,0.0,0.0]", f"projector.horizontal_fov_deg={FOV}", f"observer.position=[0.0,0.0,{DISTANCE}]", "render.depth=12",
                  f"render.spp={per_run}", "render.method=\"full\"", f"render.seed={seed + 1}"]:
            command += ["--set", s]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(done.stderr)
        pictures.append(read_pfm(next(out.glob("*.pfm"))))
    return np.array(pictures)


def mitsuba_pictures(args, parts, theirs, medium, blocks):
    import mitsuba as mi
    mi.set_variant(args.variant)
    width, height = args.size
    scene = {
        "type": "scene", "integrator": {"type": "volpath" if medium else "path", "max_depth": 13, "rr_depth": 100},
        "sky": {"type": "constant", "radiance": rgb(SKY, SKY, SKY)},
        "sensor": {"type": "perspective", "fov": FOV, "fov_axis": "x",
                   "to_world": mi.ScalarTransform4f().look_at([0, 0, DISTANCE], [0, 0, 0], [0, 1, 0]),
                   "film": {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}},
                   "sampler": {"type": "independent"}},
    }
    for name, (positions, normals, _, uvs, indices), _ in parts:
        props = mi.Properties()
        if name == "ball":
            props["bsdf"] = mi.load_dict(theirs)
            if medium:
                props["interior"] = mi.load_dict(medium)
        else:
            props["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": rgb(0, 0, 0)}})
            props["emitter"] = mi.load_dict({"type": "area", "radiance": rgb(CEILING, CEILING, CEILING)})
        mesh = mi.Mesh(name, len(positions), len(indices), has_vertex_normals=True, has_vertex_texcoords=True, props=props)
        params = mi.traverse(mesh)
        params["vertex_positions"] = np.array(positions, np.float32).ravel()
        params["vertex_normals"] = np.array(normals, np.float32).ravel()
        params["vertex_texcoords"] = np.array([(u, 1 - v) for u, v in uvs], np.float32).ravel()
        params["faces"] = np.array(indices, np.uint32).ravel()
        params.update()
        scene[name] = mesh
    scene = mi.load_dict(scene)
    return np.array([np.array(mi.render(scene, spp=max(args.spp // blocks, 1), seed=k)) for k in range(blocks)])


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("names", nargs="*", default=list(CASES))
    parser.add_argument("--dpm", default="target/release/dpm")
    parser.add_argument("--spp", type=int, default=4096)
    parser.add_argument("--raster", default="64x64")
    parser.add_argument("--variant", default="scalar_rgb")
    parser.add_argument("--save")
    args = parser.parse_args()
    args.size = tuple(int(v) for v in args.raster.split("x"))
    width, height = args.size
    y, x = np.mgrid[0:height, 0:width]
    tangent = math.tan(math.radians(FOV / 2)) / (width / 2)
    radius = np.hypot(x + 0.5 - width / 2, y + 0.5 - height / 2) * tangent * DISTANCE
    inner = radius < 0.8 * RADIUS
    print(f"{'case':24} {'channel':>7} {'dpm':>9} {'mitsuba':>9} {'per cent':>9} {'+-':>6}")
    for name in args.names:
        ours, theirs, *medium = CASES[name]()
        with tempfile.TemporaryDirectory() as folder:
            parts = shapes(ours)
            a = dpm_pictures(args, parts, pathlib.Path(folder))
        b = mitsuba_pictures(args, parts, theirs, medium[0] if medium else None, 16)
        if args.save:
            np.savez(f"{args.save}-{name}.npz", dpm=a.mean(0), mitsuba=b.mean(0))
        for c, channel in enumerate("rgb"):
            means = [p[:, inner, c].mean(1) for p in (a, b)]
            error = math.sqrt(sum(m.var(ddof=1) / len(m) if len(m) > 1 else 0.0 for m in means))
            m, t = means[0].mean(), means[1].mean()
            scale = max(t, 1e-9)
            print(f"{name:24} {channel:>7} {m:9.5f} {t:9.5f} {100 * (m - t) / scale:9.3f} {100 * error / scale:6.3f}", flush=True)


if __name__ == "__main__":
    main()
