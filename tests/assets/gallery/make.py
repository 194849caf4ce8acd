#!/usr/bin/env python3
"""Writes gallery.gltf beside it: a wall of balls, one a material of docs/RENDERING.md, "Lobes of materials".

    tests/assets/gallery/make.py
    dpm demo --scene tests/assets/gallery/gallery.gltf --raster 640x480 --set render.depth=8 --set render.exposure=2 --out out/gallery

The balls stand in rows before a chequered board, so that what lets light through is seen to. All share one mesh with tangents along the
circles of latitude. The file is text, has no neighbours, and is the same in every run.
"""
import base64
import json
import math
import pathlib
import struct
import zlib

RADIUS = 0.03
SPACING = 0.075
# Height of the middle: where the demo's projector looks.
MIDDLE = 0.03
COLUMNS = 6
AROUND, UP = 40, 20


def png(width, height, pixels):
    rows = b"".join(b"\0" + bytes(v for x in range(width) for v in pixels(x, y)) for y in range(height))
    chunk = lambda kind, data: struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    head = struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows, 9)) + chunk(b"IEND", b"")


def data_uri(kind, data):
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def ball():
    positions, normals, tangents, uvs, indices = [], [], [], [], []
    for j in range(UP + 1):
        for i in range(AROUND + 1):
            u, v = i / AROUND, j / UP
            azimuth, polar = 2 * math.pi * u, math.pi * v
            n = (math.sin(polar) * math.sin(azimuth), math.cos(polar), math.sin(polar) * math.cos(azimuth))
            normals.append(n)
            positions.append(tuple(RADIUS * c for c in n))
            tangents.append((math.cos(azimuth), 0.0, -math.sin(azimuth), 1.0))
            uvs.append((u, v))
    for j in range(UP):
        for i in range(AROUND):
            a, b = j * (AROUND + 1) + i, (j + 1) * (AROUND + 1) + i
            indices += ([(a, b, a + 1)] if j > 0 else []) + ([(a + 1, b, b + 1)] if j < UP - 1 else [])
    return positions, normals, tangents, uvs, indices


def board(half_x, half_y, z):
    positions = [(-half_x, -half_y, z), (half_x, -half_y, z), (half_x, half_y, z), (-half_x, half_y, z)]
    uvs = [(0, half_y / half_x), (1, half_y / half_x), (1, 0), (0, 0)]
    return positions, [(0, 0, 1)] * 4, [(1, 0, 0, 1)] * 4, uvs, [(0, 1, 2), (0, 2, 3)]


def pbr(color, metallic=0.0, roughness=0.5, **more):
    return {"pbrMetallicRoughness": {"baseColorFactor": [*color, 1.0][:4], "metallicFactor": metallic, "roughnessFactor": roughness}, **more}


def lobes(base, **extensions):
    return {**base, "extensions": {f"KHR_materials_{k}": v for k, v in extensions.items()}}


def materials():
    grey, red, gold = (0.5, 0.5, 0.5), (0.6, 0.02, 0.02), (1.0, 0.77, 0.34)
    glass = pbr((1, 1, 1), 0.0, 0.0)
    solid = lambda **e: lobes(glass, transmission={"transmissionFactor": 1}, volume={"thicknessFactor": RADIUS, **e.pop("volume", {})}, **e)
    film = lambda **e: {"iridescenceFactor": 1, "iridescenceThicknessMinimum": 100, **e}
    veil = pbr((0.9, 0.6, 0.2), 0.0, 0.6, alphaMode="BLEND", doubleSided=True)
    veil["pbrMetallicRoughness"]["baseColorFactor"][3] = 0.4
    bumps = {"index": 1, "scale": 0.6}
    return [
        ("plain red", pbr(red, 0, 0.6)),
        ("clear coat", lobes(pbr(red, 0, 0.6), clearcoat={"clearcoatFactor": 1})),
        ("rough coat", lobes(pbr(red, 0, 0.6), clearcoat={"clearcoatFactor": 1, "clearcoatRoughnessFactor": 0.3})),
        ("coat over bumps", lobes(pbr(red, 0, 0.6, normalTexture=bumps), clearcoat={"clearcoatFactor": 1})),
        ("bumps in the coat", lobes(pbr(red, 0, 0.6), clearcoat={"clearcoatFactor": 1, "clearcoatNormalTexture": bumps})),
        ("coat over gold", lobes(pbr(gold, 1, 0.4), clearcoat={"clearcoatFactor": 1})),
        ("specular 0", lobes(pbr(grey, 0, 0.2), specular={"specularFactor": 0})),
        ("specular 1", pbr(grey, 0, 0.2)),
        ("specular green", lobes(pbr(grey, 0, 0.2), specular={"specularColorFactor": [0.5, 8.0, 0.5]})),
        ("brushed along", lobes(pbr(gold, 1, 0.2), anisotropy={"anisotropyStrength": 0.8})),
        ("brushed across", lobes(pbr(gold, 1, 0.2), anisotropy={"anisotropyStrength": 0.8, "anisotropyRotation": math.pi / 2})),
        ("brushed at 45 degrees", lobes(pbr(gold, 1, 0.2), anisotropy={"anisotropyStrength": 0.8, "anisotropyRotation": math.pi / 4})),
        ("velvet", lobes(pbr((0.1, 0.02, 0.15), 0, 1), sheen={"sheenColorFactor": [0.9, 0.4, 0.9], "sheenRoughnessFactor": 0.3})),
        ("cloth", lobes(pbr((0.05, 0.1, 0.3), 0, 1), sheen={"sheenColorFactor": [0.6, 0.7, 1.0], "sheenRoughnessFactor": 0.8})),
        ("film on black", lobes(pbr((0.0, 0.0, 0.0), 0, 0.05), iridescence=film(iridescenceIor=1.8, iridescenceThicknessMaximum=500))),
        ("film on metal", lobes(pbr((0.8, 0.8, 0.8), 1, 0.15), iridescence=film(iridescenceThicknessMaximum=400))),
        ("film of a gradient", lobes(pbr((0.8, 0.8, 0.8), 1, 0.15), iridescence=film(
            iridescenceThicknessMinimum=0, iridescenceThicknessMaximum=1200, iridescenceThicknessTexture={"index": 2}))),
        ("soap bubble", lobes(glass, transmission={"transmissionFactor": 1}, ior={"ior": 1.0},
                              iridescence=film(iridescenceThicknessMaximum=500))),
        ("clear glass", solid()),
        ("green glass", solid(volume={"attenuationColor": [0.2, 0.9, 0.3], "attenuationDistance": 0.03})),
        ("diamond", solid(ior={"ior": 2.4}, dispersion={"dispersion": 5.0})),
        ("leaf", lobes(pbr((0.3, 0.6, 0.1), 0, 0.5), diffuse_transmission={
            "diffuseTransmissionFactor": 0.7, "diffuseTransmissionColorFactor": [0.5, 0.9, 0.1]})),
        ("veil", veil),
        ("jade", lobes(pbr((0.2, 0.6, 0.4), 0, 0.4), ior={"ior": 1.6}, clearcoat={"clearcoatFactor": 0.5},
                       diffuse_transmission={"diffuseTransmissionFactor": 0.5, "diffuseTransmissionColorFactor": [0.4, 1.0, 0.7]},
                       volume={"thicknessFactor": RADIUS, "attenuationColor": [0.3, 0.9, 0.6], "attenuationDistance": 0.02})),
    ]


def main():
    blob, views, accessors, meshes, nodes = bytearray(), [], [], [], []

    def accessor(values, kind, component, code, target):
        views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": len(values) * len(values[0]) * struct.calcsize(code), "target": target})
        for value in values:
            blob.extend(struct.pack("<" + code * len(value), *value))
        while len(blob) % 4:
            blob.append(0)
        count = len(values) * (len(values[0]) if kind == "SCALAR" else 1)
        entry = {"bufferView": len(views) - 1, "componentType": component, "count": count, "type": kind}
        if kind == "VEC3":
            entry["min"] = [min(v[c] for v in values) for c in range(3)]
            entry["max"] = [max(v[c] for v in values) for c in range(3)]
        accessors.append(entry)
        return len(accessors) - 1

    def primitive(shape):
        positions, normals, tangents, uvs, indices = shape
        places = {"POSITION": accessor(positions, "VEC3", 5126, "f", 34962), "NORMAL": accessor(normals, "VEC3", 5126, "f", 34962),
                  "TANGENT": accessor(tangents, "VEC4", 5126, "f", 34962), "TEXCOORD_0": accessor(uvs, "VEC2", 5126, "f", 34962)}
        return {"attributes": places, "indices": accessor(indices, "SCALAR", 5123, "H", 34963)}

    looks = materials()
    rows = math.ceil(len(looks) / COLUMNS)
    of_ball = primitive(ball())
    half = (SPACING * (COLUMNS + 1) / 2, SPACING * (rows + 1) / 2)
    for k, (name, _) in enumerate(looks):
        meshes.append({"name": name, "primitives": [{**of_ball, "material": k}]})
        x, y = (k % COLUMNS - (COLUMNS - 1) / 2) * SPACING, ((rows - 1) / 2 - k // COLUMNS) * SPACING
        nodes.append({"name": name, "mesh": k, "translation": [round(x, 4), round(y + MIDDLE, 4), 0]})
    backdrop = {"name": "board", **pbr((1, 1, 1), 0, 1)}
    backdrop["pbrMetallicRoughness"]["baseColorTexture"] = {"index": 0}
    meshes.append({"name": "board", "primitives": [{**primitive(board(*half, -0.06)), "material": len(looks)}]})
    nodes.append({"name": "board", "mesh": len(looks), "translation": [0, MIDDLE, 0]})

    def bump(x, y):
        # Waves as normals; they repeat without a seam.
        dx, dy = math.cos(2 * math.pi * x / 16) * 0.5, math.cos(2 * math.pi * y / 16) * 0.5
        length = math.sqrt(dx * dx + dy * dy + 1)
        return [round(127.5 + 127.5 * c / length) for c in (dx, dy, 1)] + [255]

    check = lambda x, y: [200, 200, 205, 255] if (x // 2 + y // 2) % 2 else [60, 60, 70, 255]
    images = [png(56, 40, check), png(64, 64, bump), png(1, 64, lambda x, y: [255, y * 255 // 63, 0, 255])]
    used = sorted({e for _, m in looks for e in m.get("extensions", {})})
    document = {
        "asset": {"version": "2.0", "generator": "tests/assets/gallery/make.py"},
        "extensionsUsed": used,
        "scene": 0,
        "scenes": [{"nodes": list(range(len(nodes)))}],
        "nodes": nodes,
        "meshes": meshes,
        "materials": [{"name": name, **m} for name, m in looks] + [backdrop],
        "textures": [{"source": 0, "sampler": 0}, {"source": 1}, {"source": 2, "sampler": 1}],
        "samplers": [{"magFilter": 9728}, {"wrapS": 33071, "wrapT": 33071}],
        "images": [{"uri": data_uri("image/png", image)} for image in images],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(blob), "uri": data_uri("application/octet-stream", bytes(blob))}],
    }
    out = pathlib.Path(__file__).with_name("gallery.gltf")
    out.write_text(json.dumps(document, indent=1) + "\n")
    print(f"{out.name}: {len(looks)} materials, {out.stat().st_size} bytes")


if __name__ == "__main__":
    main()
