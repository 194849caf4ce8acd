#!/usr/bin/env python3
"""Samples per second of `dpm bench`'s method `full` and of Mitsuba 3, side by side: the same meshes, view, sky and depth, in turns.

    pip install mitsuba numpy
    tests/peers/mitsuba_bench.py SCENE.glb [--dpm target/release/dpm] [--raster 1024x768] [--spp 2] [--depth 4] [--rounds 5] [--variant llvm_ad_rgb]

SCENE is a binary glTF file without textures whose meshes hang on nodes at the top (the four scans of the paper's experiment). Base colours become
diffuse, or rough dielectric over diffuse where the roughness is below 1. A sample is a path that starts on a body: misses cost little, so
they do not count, on either side. Prints one JSON object.
"""
import argparse
import json
import os
import struct
import subprocess
import time

import numpy as np


def load_glb(path):
    data = open(path, "rb").read()
    length = struct.unpack_from("<I", data, 12)[0]
    doc = json.loads(data[20:20 + length])
    blob = data[20 + length + 8:]
    kinds = {5121: np.uint8, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}

    def accessor(i):
        a = doc["accessors"][i]
        view = doc["bufferViews"][a["bufferView"]]
        width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}[a["type"]]
        start = view.get("byteOffset", 0) + a.get("byteOffset", 0)
        values = np.frombuffer(blob, kinds[a["componentType"]], a["count"] * width, start)
        return values.reshape(-1, width)

    bodies = []
    for node in doc["nodes"]:
        if "mesh" not in node:
            continue
        to_world = np.array(node.get("matrix", np.eye(4).ravel())).reshape(4, 4).T
        if "translation" in node:
            to_world[:3, 3] = node["translation"]
        for p in doc["meshes"][node["mesh"]]["primitives"]:
            vertices = accessor(p["attributes"]["POSITION"]) @ to_world[:3, :3].T + to_world[:3, 3]
            normals = accessor(p["attributes"]["NORMAL"]) @ to_world[:3, :3].T
            bodies.append((node.get("name", "?"), vertices, normals, accessor(p["indices"]).ravel(), doc["materials"][p["material"]]))
    return bodies


def mitsuba_scene(mi, bodies, args):
    width, height = args.size
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": args.depth},
        "sky": {"type": "constant", "radiance": 1.0},
        "sensor": {
            "type": "perspective", "fov": 30.0, "fov_axis": "x",
            "to_world": mi.ScalarTransform4f().look_at([0.0, 0.10, 1.0], [0.0, 0.03, -0.05], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}},
            "sampler": {"type": "independent", "sample_count": args.spp},
        },
    }
    for k, (name, vertices, normals, indices, material) in enumerate(bodies):
        pbr = material["pbrMetallicRoughness"]
        color = {"type": "rgb", "value": list(pbr.get("baseColorFactor", [1, 1, 1])[:3])}
        alpha = max(pbr.get("roughnessFactor", 1.0) ** 2, 1e-4)
        if pbr.get("metallicFactor", 1.0) > 0.5:
            bsdf = {"type": "roughconductor", "distribution": "ggx", "alpha": alpha, "material": "Ag"}
        elif alpha < 1.0:
            bsdf = {"type": "roughplastic", "distribution": "ggx", "alpha": alpha, "diffuse_reflectance": color}
        else:
            bsdf = {"type": "diffuse", "reflectance": color}
        mesh = mi.Mesh(name, len(vertices), len(indices) // 3, has_vertex_normals=True, props=props_with(mi, bsdf))
        params = mi.traverse(mesh)
        params["vertex_positions"] = np.ascontiguousarray(vertices, np.float32).ravel()
        params["vertex_normals"] = np.ascontiguousarray(normals, np.float32).ravel()
        params["faces"] = np.ascontiguousarray(indices, np.uint32)
        params.update()
        scene[f"body{k}"] = mesh
    return mi.load_dict(scene)


def props_with(mi, bsdf):
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(bsdf)
    return props


def lit_share(mi, scene, spp=4):
    """Share of the picture that a body covers."""
    aov = mi.load_dict({"type": "aov", "aovs": "d:depth"})
    depth = np.array(mi.render(scene, integrator=aov, spp=spp))[..., -1]
    return float((depth > 0).mean())


def dpm_bench(args):
    sets = [
        'scene.environment={kind="constant",radiance=[1.0,1.0,1.0]}', "projector.position=[0.0,0.10,1.0]",
        "projector.look_at=[0.0,0.03,-0.05]", "observer.position=[0.15,0.12,1.0]", f"render.depth={args.depth}", f"render.spp={args.spp}",
        'scene.bodies=[{name="Bunny",motion={kind="still"}},{name="Venus",motion={kind="still"}}]',
    ]
    command = [args.dpm, "bench", "--json", "--scene", args.scene, "--raster", args.raster, "--count", "5", "--method", "full"]
    for s in sets:
        command += ["--set", s]
    report = json.loads(subprocess.run(command, capture_output=True, check=True, text=True).stdout)
    return next(m for m in report["methods"] if m["method"] == "full")


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("scene")
    parser.add_argument("--dpm", default="target/release/dpm")
    parser.add_argument("--raster", default="1024x768")
    parser.add_argument("--spp", type=int, default=2)
    parser.add_argument("--depth", type=int, default=4)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--variant", default="llvm_ad_rgb")
    args = parser.parse_args()
    args.size = tuple(int(v) for v in args.raster.split("x"))
    import mitsuba as mi
    mi.set_variant(args.variant)
    scene = mitsuba_scene(mi, load_glb(args.scene), args)
    share = lit_share(mi, scene)
    on_bodies = share * args.size[0] * args.size[1] * args.spp
    render = lambda seed: np.array(mi.render(scene, spp=args.spp, seed=seed))
    render(0)  # compiles
    theirs, ours = [], []
    for k in range(args.rounds):
        begin = time.perf_counter()
        for seed in range(5):
            render(5 * k + seed + 1)
        theirs.append((time.perf_counter() - begin) / 5)
        ours.append(dpm_bench(args))
    t, o = float(np.median(theirs)), ours[int(np.argsort([m["wall_ms"] for m in ours])[len(ours) // 2])]
    print(json.dumps({
        "scene": os.path.basename(args.scene), "raster": args.raster, "spp": args.spp, "depth": args.depth, "covered": round(share, 4),
        "mitsuba": {"version": mi.__version__, "variant": args.variant, "ms": round(t * 1e3, 1), "msamples_per_s": round(on_bodies / t * 1e-6, 3)},
        "dpm": {"ms": round(o["wall_ms"], 1), "msamples_per_s": round(o["samples_per_frame"] / o["wall_ms"] * 1e-3, 3)},
        "ratio": round(o["samples_per_frame"] / o["wall_ms"] * 1e3 / (on_bodies / t), 3),
    }))


main()
