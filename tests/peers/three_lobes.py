#!/usr/bin/env python3
"""Radiance of `dpm snapshot` beside that of three.js, for the lobes of materials that glTF's extensions add: one ball a material under one
directional light, which both programs read from one file. There is no other light, so what is compared is the reflectance of the surface itself.

    pip install numpy; npm install three; apt-get install chromium
    tests/peers/three_lobes.py --three node_modules/three [--dpm target/release/dpm] [--chromium chromium] [NAME...]

Prints the mean of both over the inner nine tenths of the ball's disk for three directions of the light, and the difference in per cent of the mean.
three.js draws 16 times the pixels and these are averaged. The two models differ in a few places, so where a closed form of the lobe can be written
down, both pictures also stand beside their own model's: ours as docs/RENDERING.md has it, theirs as the shaders of three.js have it. The five places:
exact Fresnel reflectance and not Schlick's; a film seen from the half vector and not from the normal; sheen by the masking of its authors and not by
Neubelt's; metals that lose what facets reflect twice, where three.js adds it; roughness, which three.js raises where normals turn within a pixel.
"""
import argparse
import functools
import http.server
import importlib.util
import json
import math
import os
import pathlib
import re
import shutil
import subprocess
import tempfile
import threading

import numpy as np

HERE = pathlib.Path(__file__).resolve().parent
SIZE, FINE = 64, 4
LIGHTS = {"front": (0.2, 0.3, 1.0), "side": (1.0, 0.4, 0.3), "behind": (0.7, 0.5, -0.6)}


def load(path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


base = load(HERE / "mitsuba_lobes.py")
plain, metal = base.material, base.metal
GREY = (0.5, 0.5, 0.5)

LAMP = 3.0

CASES = {
    "lambert": plain(GREY, 0.0, 1.0, ior={"ior": 1.0}),
    "metal": metal((0.9, 0.6, 0.3), 0.5),
    "dielectric": plain(GREY, 0.0, 0.5),
    "dielectric-black": plain((0, 0, 0), 0.0, 0.5),
    "specular-black": plain((0, 0, 0), 0.0, 0.5, specular={"specularFactor": 0.5, "specularColorFactor": [1.0, 0.5, 0.1]}),
    "coat-over-black": plain((0, 0, 0), 0.0, 1.0, ior={"ior": 1.0}, specular={"specularFactor": 0.0}, clearcoat={"clearcoatFactor": 1.0, "clearcoatRoughnessFactor": 0.4}),
    "half-coat-over-black": plain((0, 0, 0), 0.0, 1.0, ior={"ior": 1.0}, specular={"specularFactor": 0.0}, clearcoat={"clearcoatFactor": 0.5, "clearcoatRoughnessFactor": 0.6}),
    "coat-over-grey": plain(GREY, 0.0, 1.0, ior={"ior": 1.0}, specular={"specularFactor": 0.0}, clearcoat={"clearcoatFactor": 1.0, "clearcoatRoughnessFactor": 0.4}),
    "brushed": metal((0.9, 0.6, 0.3), 0.4, anisotropy={"anisotropyStrength": 0.7}),
    "brushed-across": metal((0.9, 0.6, 0.3), 0.4, anisotropy={"anisotropyStrength": 0.7, "anisotropyRotation": math.pi / 2}),
    "brushed-askew": metal((0.9, 0.6, 0.3), 0.5, anisotropy={"anisotropyStrength": 0.5, "anisotropyRotation": 0.6}),
    "sheen-over-black": plain((0, 0, 0), 0.0, 1.0, ior={"ior": 1.0}, specular={"specularFactor": 0.0}, sheen={"sheenColorFactor": [1.0, 0.5, 0.2], "sheenRoughnessFactor": 0.5}),
    "sheen-soft-over-black": plain((0, 0, 0), 0.0, 1.0, ior={"ior": 1.0}, specular={"specularFactor": 0.0}, sheen={"sheenColorFactor": [1, 1, 1], "sheenRoughnessFactor": 0.9}),
    "sheen-over-grey": plain(GREY, 0.0, 1.0, ior={"ior": 1.0}, specular={"specularFactor": 0.0}, sheen={"sheenColorFactor": [1, 1, 1], "sheenRoughnessFactor": 0.5}),
    "film-on-copper": metal((0.9, 0.6, 0.3), 0.4, iridescence={"iridescenceFactor": 1.0, "iridescenceIor": 1.8, "iridescenceThicknessMaximum": 400.0}),
    "film-on-black": plain((0, 0, 0), 0.0, 0.4, iridescence={"iridescenceFactor": 1.0, "iridescenceIor": 1.6, "iridescenceThicknessMaximum": 300.0}),
    "thick-film-on-black": plain((0, 0, 0), 0.0, 0.5, iridescence={"iridescenceFactor": 1.0, "iridescenceIor": 1.3, "iridescenceThicknessMaximum": 900.0}),
}


def dot(a, b):
    return (a * b).sum(-1)


def schlick(f0, c, f90=1.0):
    return f0 + (f90 - f0) * (1 - c[:, None]) ** 5


def exact(eta, c):
    """Fresnel's reflectance of a dielectric from outside."""
    t = np.sqrt(1 - (1 - c * c) / eta**2)
    return (((c - eta * t) / (c + eta * t)) ** 2 + ((eta * c - t) / (eta * c + t)) ** 2)[:, None] / 2


def ggx(at, ab, n, t, b, v, l):
    """Distribution times masking over 4 n.v n.l, with widths along tangent and bitangent."""
    h = (v + l) / np.linalg.norm(v + l, axis=-1, keepdims=True)
    d = 1 / (math.pi * at * ab * ((dot(h, t) / at) ** 2 + (dot(h, b) / ab) ** 2 + dot(h, n) ** 2) ** 2)
    length = lambda w: np.sqrt((at * dot(w, t)) ** 2 + (ab * dot(w, b)) ** 2 + dot(w, n) ** 2)
    return (d * 0.5 / (dot(n, l) * length(v) + dot(n, v) * length(l)))[:, None]


def albedo(alpha, mu):
    """Of facets that reflect everything, by 200 x 200 directions."""
    u, phi = np.meshgrid((np.arange(200) + 0.5) / 200, (np.arange(200) + 0.5) / 200 * 2 * math.pi)
    # Half vectors as GGX has them, so that narrow lobes are met.
    cos2 = (1 - u) / (1 + (alpha**2 - 1) * u)
    h = np.stack([np.sqrt(1 - cos2) * np.cos(phi), np.sqrt(1 - cos2) * np.sin(phi), np.sqrt(cos2)], -1).reshape(-1, 3)
    v = np.array([math.sqrt(1 - mu * mu), 0.0, mu])
    vh = h @ v
    l = 2 * vh[:, None] * h - v
    lam = lambda c: (np.sqrt(1 + alpha**2 * (1 / c**2 - 1)) - 1) / 2
    ok = (l[:, 2] > 0) & (vh > 0)
    g = 1 / (1 + lam(mu) + lam(np.where(ok, l[:, 2], 1.0)))
    return np.where(ok, g * vh / (mu * h[:, 2]), 0).mean()


def film(eta, nm, f0, c, first):
    """Belcour and Barla's reflectance with Khronos's sensitivities; `first`: that of the upper interface."""
    c2 = np.sqrt(1 - (1 - c * c) / eta**2)
    r12 = first(c)
    t = 1 - r12
    index = (1 + np.sqrt(np.clip(f0, 0, 0.9999))) / (1 - np.sqrt(np.clip(f0, 0, 0.9999)))
    r23 = schlick(((index - eta) / (index + eta)) ** 2, c2)
    phi = math.pi + np.where(index < eta, math.pi, 0.0)
    r123 = np.clip(r12 * r23, 1e-5, 0.9999)
    rs = t**2 * r23 / (1 - r123)
    total, cm = r12 + rs, rs - t
    to_rgb = np.array([[3.2404542, -1.5371385, -0.4985314], [-0.9692660, 1.8760108, 0.0415560], [0.0556434, -0.2040259, 1.0572252]])
    for m in (1, 2):
        cm = cm * np.sqrt(r123)
        phase, shift = 2 * math.pi * (m * 2 * eta * nm * c2)[:, None] * 1e-9, m * phi
        value, place, spread = np.array([5.4856e-13, 4.4201e-13, 5.2481e-13]), np.array([1.6810e6, 1.7953e6, 2.2084e6]), np.array([4.3278e9, 9.3046e9, 6.6121e9])
        xyz = value * np.sqrt(2 * math.pi * spread) * np.cos(place * phase + shift) * np.exp(-(phase**2) * spread)
        xyz[:, :1] += 9.7470e-14 * math.sqrt(2 * math.pi * 4.5282e9) * np.cos(2.2399e6 * phase + np.ravel(shift)[0]) * np.exp(-4.5282e9 * phase**2)
        total = total + cm * 2 * (xyz / 1.0685e-7 @ to_rgb.T)
    return np.maximum(total, 0)


def sheen(look, n, v, l, is_ours):
    color, alpha = np.array(look["sheenColorFactor"]), look["sheenRoughnessFactor"] ** 2
    h = (v + l) / np.linalg.norm(v + l, axis=-1, keepdims=True)
    nv, nl = dot(n, v), dot(n, l)
    d = (2 + 1 / alpha) * np.sqrt(1 - np.minimum(dot(n, h), 1) ** 2) ** (1 / alpha) / (2 * math.pi)
    if not is_ours:
        return color * (d / (4 * (nl + nv - nl * nv)))[:, None]
    # The fit of the authors of the lobe, as Khronos gives it.
    low, high, k = (25.3245, 3.32435, 0.16801, -1.27393, -4.85967), (21.5473, 3.82987, 0.19823, -1.97760, -4.32054), (1 - alpha) ** 2
    a, b, c, e, f = (k * x + (1 - k) * y for x, y in zip(low, high))
    fit = lambda x: a / (1 + b * x**c) + e * x + f
    lam = lambda x: np.where(x < 0.5, np.exp(fit(x)), np.exp(2 * fit(0.5) - fit(1 - x)))
    return color * (d / (4 * nv * nl * (1 + lam(nv) + lam(nl))))[:, None]


def closed_form(look, to, is_ours):
    """The mean over the inner disk of the lobe alone, or None where the base takes part."""
    pbr, ext = look["pbrMetallicRoughness"], {k[14:]: v for k, v in look.get("extensions", {}).items()}
    color, is_metal, rough = np.array(pbr["baseColorFactor"][:3]), pbr["metallicFactor"] > 0, pbr["roughnessFactor"]
    fine = SIZE * FINE
    y, x = np.mgrid[0:fine, 0:fine]
    tangent = math.tan(math.radians(base.FOV / 2)) / (fine / 2)
    d = np.stack([(x + 0.5 - fine / 2) * tangent, -(y + 0.5 - fine / 2) * tangent, -np.ones_like(x, float)], -1).reshape(-1, 3)
    d = d[np.hypot(*(np.floor(v.ravel() / FINE) + 0.5 - SIZE / 2 for v in (x, y))) * tangent * FINE * base.DISTANCE < 0.9 * base.RADIUS]
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    eye = np.array([0, 0, base.DISTANCE])
    s = -(d @ eye) - np.sqrt((d @ eye) ** 2 - base.DISTANCE**2 + base.RADIUS**2)
    n, l = (eye + s[:, None] * d) / base.RADIUS, np.array(to) / np.linalg.norm(to)
    every, n, v = len(d), n[n @ l > 0], -d[n @ l > 0]
    l = np.broadcast_to(l, n.shape)
    t = np.cross((0.0, 1.0, 0.0), n)
    t /= np.linalg.norm(t, axis=-1, keepdims=True)
    turn = ext.get("anisotropy", {}).get("anisotropyRotation", 0.0)
    t = math.cos(turn) * t + math.sin(turn) * np.cross(n, t)
    h = (v + l) / np.linalg.norm(v + l, axis=-1, keepdims=True)
    c, alpha, f0 = np.minimum(dot(v, h), 1), rough**2, np.where(is_metal, color, 0.04)
    lobe = lambda at, ab=None: ggx(at, ab or at, n, t, np.cross(n, t), v, l)
    strength = ext.get("anisotropy", {}).get("anisotropyStrength", 0.0)
    if not is_metal and color.any():
        if look.get("extensions") != {"KHR_materials_ior": {"ior": 1.0}}:
            return None
        f = np.broadcast_to(color / math.pi, n.shape)
    elif "clearcoat" in ext:
        coat = ext["clearcoat"]
        fresnel = exact(1.5, c) if is_ours else schlick(0.04, c)
        f = coat["clearcoatFactor"] * fresnel * lobe(coat["clearcoatRoughnessFactor"] ** 2)
    elif "sheen" in ext:
        f = sheen(ext["sheen"], n, v, l, is_ours)
    else:
        fresnel = schlick(f0, c) if is_metal or not is_ours else exact(1.5, c)
        if "specular" in ext:
            k, w = ext["specular"]["specularFactor"], (exact(1.5, c) - 0.04) / 0.96 if is_ours else schlick(0.0, c)
            f0 = np.minimum(np.array(ext["specular"]["specularColorFactor"]) * 0.04, 1)
            fresnel = k * (f0 + (1 - f0) * w)
        if "iridescence" in ext:
            eta, nm = ext["iridescence"]["iridescenceIor"], ext["iridescence"]["iridescenceThicknessMaximum"]
            if is_ours:
                shown = film(eta, nm, f0, c, lambda c: exact(eta, c)) - schlick(f0, c)
                fresnel = np.clip(fresnel + shown, 0, 1)
            else:
                fresnel = film(eta, nm, f0, np.minimum(dot(n, v), 1), lambda c: schlick(((eta - 1) / (eta + 1)) ** 2, c))
        f = fresnel * lobe(alpha + (1 - alpha) * strength**2, alpha)
        if is_metal and not is_ours:
            grid = np.linspace(0.02, 1, 50)
            f = f * (1 + f0 * (1 / np.interp(dot(n, v), grid, [albedo(alpha, mu) for mu in grid])[:, None] - 1))
    return (LAMP * f * dot(n, l)[:, None]).sum(0) / every

PAGE = """<!doctype html><script type="importmap">{"imports": {"three": "/three/build/three.module.js"}}</script>
<script type="module">
import * as THREE from 'three';
import { GLTFLoader } from '/three/examples/jsm/loaders/GLTFLoader.js';
const told = document.createElement('pre');
try {
  const size = %(size)d, renderer = new THREE.WebGLRenderer();
  renderer.toneMapping = THREE.NoToneMapping;
  const target = new THREE.WebGLRenderTarget(size, size, { type: THREE.FloatType });
  const { scene } = await new GLTFLoader().loadAsync('/scene.gltf');
  const world = new THREE.Scene();
  world.add(scene);
  const camera = new THREE.PerspectiveCamera(%(fov)f, 1, 0.01, 10);
  camera.position.set(0, 0, %(distance)f);
  renderer.setRenderTarget(target);
  renderer.setClearColor(0, 0);
  renderer.clear();
  renderer.render(world, camera);
  const pixels = new Float32Array(4 * size * size);
  renderer.readRenderTargetPixels(target, 0, 0, size, size, pixels);
  told.textContent = JSON.stringify(Array.from(pixels, (v) => Number(v.toPrecision(6))));
} catch (e) { told.textContent = 'error: ' + e; }
document.body.append(told);
</script>"""


def write(path, look, light):
    parts = [("ball", base.gallery().ball(), look)]
    base.write_scene(path, parts)
    document = json.loads(path.read_text())
    # A directional light shines along -z of its node.
    to = np.array(light) / np.linalg.norm(light)
    axis = np.cross((0.0, 0.0, 1.0), to)
    half = math.acos(np.clip(to[2], -1.0, 1.0)) / 2
    axis = axis / max(np.linalg.norm(axis), 1e-12) * math.sin(half)
    document["extensions"] = {"KHR_lights_punctual": {"lights": [{"type": "directional", "intensity": LAMP}]}}
    document["extensionsUsed"].append("KHR_lights_punctual")
    document["nodes"].append({"name": "lamp", "rotation": [*axis, math.cos(half)], "extensions": {"KHR_lights_punctual": {"light": 0}}})
    document["scenes"][0]["nodes"].append(len(document["nodes"]) - 1)
    path.write_text(json.dumps(document))


def dpm_picture(args, scene, folder):
    command = [args.dpm, "snapshot", str(scene), "--raster", f"{SIZE}x{SIZE}", "--what", "radiance", "--frame", "0", "--out", str(folder)]
    for s in ['scene.environment={kind="constant",radiance=[0.0,0.0,0.0]}', f"projector.position=[0.0,0.0,{base.DISTANCE}]",
              "projector.look_at=[0.0,0.0,0.0]", f"projector.horizontal_fov_deg={base.FOV}", f"observer.position=[0.0,0.0,{base.DISTANCE}]",
              "render.depth=2", "render.spp=64", 'render.method="full"']:
        command += ["--set", s]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stderr)
    return base.read_pfm(next(folder.glob("*.pfm")))


def three_picture(args, scene, folder):
    size = SIZE * FINE
    (folder / "three").symlink_to(pathlib.Path(args.three).resolve())
    shutil.copy(scene, folder / "scene.gltf")
    (folder / "page.html").write_text(PAGE % {"size": size, "fov": base.FOV, "distance": base.DISTANCE})

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_):
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    command = [args.chromium, "--headless", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-first-run",
               "--disable-background-networking", "--disable-component-update", "--disable-sync", "--virtual-time-budget=60000", f"--user-data-dir={folder}/profile",
               "--dump-dom", f"http://127.0.0.1:{server.server_port}/page.html"]
    page = subprocess.run(command, capture_output=True, text=True, timeout=300).stdout
    server.shutdown()
    found = re.search(r"<pre>(.*?)</pre>", page, re.S)
    if not found or found[1].startswith("error"):
        raise SystemExit(f"three.js drew nothing: {found[1] if found else page[:400]}")
    fine = np.array(json.loads(found[1]), np.float64).reshape(SIZE, FINE, SIZE, FINE, 4)
    return fine.mean((1, 3))[::-1, :, :3]


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("names", nargs="*", default=list(CASES))
    parser.add_argument("--dpm", default="target/release/dpm")
    parser.add_argument("--three", default="node_modules/three")
    parser.add_argument("--chromium", default="chromium")
    parser.add_argument("--save", help="a folder for the pictures, as numpy archives")
    args = parser.parse_args()
    y, x = np.mgrid[0:SIZE, 0:SIZE]
    tangent = math.tan(math.radians(base.FOV / 2)) / (SIZE / 2)
    inner = np.hypot(x + 0.5 - SIZE / 2, y + 0.5 - SIZE / 2) * tangent * base.DISTANCE < 0.9 * base.RADIUS
    print(f"{'case':22} {'light':7} {'dpm (r, g, b)':27} {'three.js':27} {'difference, per cent':23}  {'own form':>7} {'its form':>9}")
    for name in args.names:
        for light, to in LIGHTS.items():
            with tempfile.TemporaryDirectory() as folder:
                folder = pathlib.Path(folder)
                scene = folder / "ball.gltf"
                write(scene, CASES[name], to)
                (folder / "page").mkdir()
                ours = dpm_picture(args, scene, folder / "dpm")
                theirs = three_picture(args, scene, folder / "page")
            if args.save:
                os.makedirs(args.save, exist_ok=True)
                np.savez(f"{args.save}/{name}-{light}.npz", dpm=ours, three=theirs)
            a, b = ours[inner].mean(0), theirs[inner].mean(0)
            off = 100 * (a - b) / np.maximum(b, 1e-6)
            row = [" ".join(f"{v:8.5f}" for v in side) for side in (a, b)]
            models = [closed_form(CASES[name], to, is_ours) for is_ours in (True, False)]
            own = ["" if m is None else f"{100 * np.abs(p - m).max() / m.mean():6.2f}" for p, m in zip((a, b), models)]
            print(f"{name:22} {light:7} {row[0]:27} {row[1]:27} {' '.join(f'{v:+7.2f}' for v in off)}  {own[0]:>7} {own[1]:>9}", flush=True)


if __name__ == "__main__":
    main()
