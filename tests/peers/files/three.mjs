// Reads mesh files with the loaders of three.js, one path a line on standard input; prints an object a line: triangles and
// sides, or why it cannot. Files beside a glTF are read from the disk. Textures and Draco need a browser and are left out.
import { readFileSync } from 'node:fs';
import { dirname } from 'node:path';
import { createInterface } from 'node:readline';
import { Box3, Matrix4, Vector3 } from 'three';
import { GLTFLoader } from 'three/examples/jsm/loaders/GLTFLoader.js';
import { OBJLoader } from 'three/examples/jsm/loaders/OBJLoader.js';
import { PLYLoader } from 'three/examples/jsm/loaders/PLYLoader.js';
import { MeshoptDecoder } from 'three/examples/jsm/libs/meshopt_decoder.module.js';
import { STLLoader } from 'three/examples/jsm/loaders/STLLoader.js';

globalThis.self = globalThis;
globalThis.ProgressEvent ??= class {};
const DISK = 'http://disk';
const fetched = globalThis.fetch;
globalThis.fetch = async (request) => {
  const url = request.url ?? request;
  return url.startsWith(DISK) ? new Response(readFileSync(decodeURIComponent(url.slice(DISK.length)))) : fetched(request);
};

const [place, point] = [new Matrix4(), new Vector3()];
const count = (geometry) => (geometry.index ?? geometry.getAttribute('position')).count / 3;

function ofGeometry(geometry) {
  geometry.computeBoundingBox();
  return { triangles: count(geometry), sides: geometry.boundingBox.getSize(new Vector3()).toArray() };
}

// The box of three.js is a box of boxes where a mesh is shown in many places.
function boxOf(object) {
  const box = new Box3();
  object.traverse((part) => {
    if (!part.isInstancedMesh) return box.union(part.isMesh ? new Box3().setFromObject(part, true) : new Box3());
    const points = part.geometry.getAttribute('position');
    for (let i = 0; i < part.count; i++) {
      part.getMatrixAt(i, place);
      place.premultiply(part.matrixWorld);
      for (let k = 0; k < points.count; k++) box.expandByPoint(point.fromBufferAttribute(points, k).applyMatrix4(place));
    }
  });
  return box;
}

function ofObject(object) {
  object.updateMatrixWorld(true);
  let triangles = 0;
  object.traverse((part) => { if (part.isMesh) triangles += count(part.geometry) * (part.isInstancedMesh ? part.count : 1); });
  return { triangles, sides: boxOf(object).getSize(new Vector3()).toArray() };
}

async function read(path) {
  const bytes = readFileSync(path);
  const buffer = bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length);
  const ending = path.toLowerCase().split('.').pop();
  if (ending === 'stl') return ofGeometry(new STLLoader().parse(buffer));
  if (ending === 'ply') return ofGeometry(new PLYLoader().parse(buffer));
  if (ending === 'obj') return ofObject(new OBJLoader().parse(bytes.toString('utf8')));
  const loader = new GLTFLoader().setMeshoptDecoder(MeshoptDecoder);
  const beside = DISK + encodeURI(dirname(path)) + '/';
  return ofObject((await loader.parseAsync(ending === 'glb' ? buffer : bytes.toString('utf8'), beside)).scene);
}

for await (const path of createInterface({ input: process.stdin })) {
  let told;
  try {
    told = await read(path);
    if (!(told.triangles > 0)) told = { refused: 'no triangles' };
    else if (!told.sides.every(Number.isFinite)) told = { refused: 'coordinates that are no numbers' };
  } catch (e) {
    told = { refused: String(e.message ?? e).slice(0, 200) };
  }
  console.log(JSON.stringify({ file: path, read: told }));
}
