// Writes web.glb and the two KTX2 images that it holds, web_etc1s.ktx2 and web_uastc.ktx2.
//
// Made with @gltf-transform/core and @gltf-transform/extensions 4.5.1, and ktx2-encoder 0.6.0, which holds Basis
// Universal's encoder as WebAssembly. In a folder where npm has installed the three, run
//
//     node make_glb.mjs FOLDER_OF_THE_OUTPUT
//
// and after it make.py, which writes the texels that opengl_basisu reads from the images.

import { writeFileSync } from "node:fs";
import { join } from "node:path";
import { Document, NodeIO } from "@gltf-transform/core";
import { KHRTextureBasisu } from "@gltf-transform/extensions";
import { ktx2 } from "ktx2-encoder/gltf-transform";

const SIDE = 32;
const out = process.argv[2];

/** Texels of a picture that `texel` gives for each place. */
function picture(texel) {
    const data = new Uint8Array(SIDE * SIDE * 4);
    for (let y = 0; y < SIDE; y++) {
        for (let x = 0; x < SIDE; x++) {
            data.set(texel(x, y), (y * SIDE + x) * 4);
        }
    }
    return { data, width: SIDE, height: SIDE };
}

const pictures = {
    colour: picture((x, y) => [x * 8, 255 - y * 8, (x ^ y) * 8, x < 16 ? 255 : y * 8]),
    bumps: picture((x, y) => [128 + 60 * Math.sin(x / 2), 128 + 60 * Math.sin(y / 3), 230, 255]),
};

const document = new Document();
document.createExtension(KHRTextureBasisu).setRequired(true);
const buffer = document.createBuffer();
const accessor = (type, numbers) => document.createAccessor().setType(type).setArray(numbers).setBuffer(buffer);
const texture = (name) =>
    document.createTexture(name).setImage(new TextEncoder().encode(name)).setMimeType("image/png");
const material = document
    .createMaterial("painted")
    .setAlphaMode("MASK")
    .setBaseColorTexture(texture("colour"))
    .setNormalTexture(texture("bumps"));
const square = document
    .createPrimitive()
    .setAttribute("POSITION", accessor("VEC3", new Float32Array([0, 0, 0, 0.1, 0, 0, 0.1, 0.1, 0, 0, 0.1, 0])))
    .setAttribute("NORMAL", accessor("VEC3", new Float32Array([0, 0, 1, 0, 0, 1, 0, 0, 1, 0, 0, 1])))
    .setAttribute("TEXCOORD_0", accessor("VEC2", new Float32Array([0, 1, 1, 1, 1, 0, 0, 0])))
    .setIndices(accessor("SCALAR", new Uint16Array([0, 1, 2, 0, 2, 3])))
    .setMaterial(material);
document.createScene().addChild(document.createNode("square").setMesh(document.createMesh().addPrimitive(square)));

// The names stand in for encoded images; the decoder gives the texels.
const imageDecoder = async (name) => pictures[new TextDecoder().decode(name)];
await document.transform(
    ktx2({
        slots: /baseColor/, isUASTC: false, generateMipmap: true, isPerceptual: true,
        isSetKTX2SRGBTransferFunc: true, imageDecoder,
    }),
);
await document.transform(
    ktx2({
        slots: /normal/, isUASTC: true, needSupercompression: true, generateMipmap: true, isNormalMap: true,
        isPerceptual: false, isSetKTX2SRGBTransferFunc: false, imageDecoder,
    }),
);
for (const texture of document.getRoot().listTextures()) {
    const name = texture.getName() === "colour" ? "web_etc1s" : "web_uastc";
    writeFileSync(join(out, `${name}.ktx2`), texture.getImage());
}
const io = new NodeIO().registerExtensions([KHRTextureBasisu]);
writeFileSync(join(out, "web.glb"), await io.writeBinary(document));
