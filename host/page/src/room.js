// The room in three dimensions: bodies, the projector with its cone, the observer, and where the tracker has seen bodies. It is drawn
// on a plain canvas, so that every browser shows it. A pose is four columns of three numbers (room.rs).
const add = (a, b, k = 1) => a.map((v, i) => v + k * b[i]), dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const scaled = (a, k) => a.map(v => v * k), unit = a => scaled(a, 1 / (Math.hypot(...a) || 1));
const column = (pose, i) => pose.slice(3 * i, 3 * i + 3);
const turned = (pose, v) => add(add(scaled(column(pose, 0), v[0]), column(pose, 1), v[1]), column(pose, 2), v[2]);
const placed = (pose, v) => add(turned(pose, v), column(pose, 3));
// The vector v, turned by the rotation vector by, radians.
function spun(v, by) {
  const angle = Math.hypot(...by), axis = unit(by), c = Math.cos(angle), s = Math.sin(angle);
  return add(add(scaled(v, c), cross(axis, v), s), axis, dot(axis, v) * (1 - c));
}
const room = { shapes: null, places: null, seen: null, dark: new Set(), yaw: 0.9, pitch: 0.4, zoom: 1, drag: null, due: false, isAsked: false };

async function askRoom() {
  if (room.shapes || room.isAsked) return;
  room.isAsked = true;
  try {
    const r = await asked("GET", "/api/room");
    if (r.ok) room.shapes = JSON.parse(r.text);
  } catch (e) { if (e instanceof NotTheRig) showFake(); }
  // A run that has not begun is asked again with its next event, at most once a second.
  setTimeout(() => { room.isAsked = false; }, 1000);
}
function onRoom(places) {
  room.places = places;
  if (!room.shapes || room.shapes.bodies.length !== places.bodies.length) { room.shapes = null; askRoom(); return; }
  // The box of all places where a tracked body has been since the page was opened.
  room.shapes.bodies.forEach((b, i) => {
    if (!b.tracked) return;
    const at = column(places.bodies[i], 3);
    room.seen = room.seen ? [room.seen[0].map((v, k) => Math.min(v, at[k])), room.seen[1].map((v, k) => Math.max(v, at[k]))] : [at, at];
  });
  drawRoomSoon();
}
function onRoomBodies(bodies) { room.dark = new Set(bodies.filter(b => b.dark).map(b => b.name)); drawRoomSoon(); }
function drawRoomSoon() {
  if (room.due || document.hidden) return;
  room.due = true;
  requestAnimationFrame(() => { room.due = false; drawRoom(); });
}

// Where the viewer stands: around the middle of everything, so far away that all of it is seen.
function roomView(canvas) {
  const { places } = room, points = [column(places.projector, 3), places.eye, ...places.bodies.filter((_, i) => room.shapes.bodies[i].projected).map(p => column(p, 3))];
  const low = points.reduce((a, b) => a.map((v, i) => Math.min(v, b[i]))), high = points.reduce((a, b) => a.map((v, i) => Math.max(v, b[i])));
  const middle = scaled(add(low, high), 0.5), reach = Math.max(Math.hypot(...add(high, low, -1)) / 2, 0.2);
  const back = [Math.sin(room.yaw) * Math.cos(room.pitch), Math.sin(room.pitch), Math.cos(room.yaw) * Math.cos(room.pitch)];
  const right = unit(cross([0, 1, 0], back)), up = cross(back, right);
  const from = add(middle, back, 3 * reach / room.zoom), focal = 1.25 * Math.min(canvas.width, canvas.height * 1.4);
  const seen = p => {
    const d = add(p, from, -1), far = -dot(d, back);
    return far > 0.01 * reach ? [canvas.width / 2 + focal * dot(d, right) / far, canvas.height / 2 - focal * dot(d, up) / far, far] : null;
  };
  return { seen, right, up, back, from, reach, low, middle, metresPerPixel: p => -dot(add(p, from, -1), back) / focal };
}
function drawRoom() {
  const canvas = $("room"), { shapes, places } = room;
  if (!shapes || !places) return;
  const density = window.devicePixelRatio || 1, width = Math.round(canvas.clientWidth * density);
  if (!width) return;
  if (canvas.width !== width) { canvas.width = width; canvas.height = Math.round(width * 0.62); }
  const g = canvas.getContext("2d"), view = roomView(canvas), parts = [];
  g.clearRect(0, 0, canvas.width, canvas.height);
  const line = (points, colour, thick = 1) => {
    const seen = points.map(view.seen);
    if (seen.some(p => !p)) return;
    g.strokeStyle = colour; g.lineWidth = thick * density; g.beginPath();
    seen.forEach((p, i) => i ? g.lineTo(p[0], p[1]) : g.moveTo(p[0], p[1])); g.stroke();
  };
  // The floor: a grid of a metre, or of ten centimetres in a small room.
  const step = view.reach > 1.5 ? 1 : view.reach > 0.15 ? 0.25 : 0.05, n = 6, floor = view.low[1] - 0.3 * view.reach;
  const [x, z] = [0, 2].map(k => Math.round(view.middle[k] / step) * step);
  for (let i = -n; i <= n; i++) {
    line([[x + i * step, floor, z - n * step], [x + i * step, floor, z + n * step]], "#1d252f");
    line([[x - n * step, floor, z + i * step], [x + n * step, floor, z + i * step]], "#1d252f");
  }
  const face = (points, colour, normal) => {
    const seen = points.map(view.seen);
    if (seen.some(p => !p)) return;
    const bright = 0.35 + 0.65 * Math.abs(dot(normal, unit(add(view.back, view.up, 0.5))));
    parts.push({ far: seen.reduce((s, p) => s + p[2], 0) / seen.length, seen, colour: colour.map(c => Math.round(c * bright)) });
  };
  shapes.bodies.forEach((b, i) => {
    // A body on which no light falls stands in the virtual world only.
    if (!b.projected) return;
    const pose = places.bodies[i], points = [];
    for (let k = 0; k < b.positions.length; k += 3) points.push(placed(pose, b.positions.slice(k, k + 3)));
    const colour = !b.tracked ? [120, 128, 138] : room.dark.has(b.tracked) ? [196, 84, 84] : [214, 220, 226];
    for (let k = 0; k < b.triangles.length; k += 3) {
      const [p, q, r] = [0, 1, 2].map(c => points[b.triangles[k + c]]);
      face([p, q, r], colour, unit(cross(add(q, p, -1), add(r, p, -1))));
    }
  });
  const projector = places.projector, lens = column(projector, 3), size = 0.09 * view.reach;
  const box = (i, half) => [0, 1, 2].map(k => (i >> k & 1 ? 1 : -1) * half[k]);
  const corners = Array.from({ length: 8 }, (_, i) => placed(projector, add(box(i, [size, 0.6 * size, 1.2 * size]), [0, 0, 1.2 * size])));
  [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]].forEach((f, i) => face(f.map(k => corners[k]), [96, 120, 168], unit(column(projector, [2, 1, 0][i >> 1]))));
  parts.sort((a, b) => b.far - a.far);
  for (const { seen, colour } of parts) {
    g.fillStyle = g.strokeStyle = `rgb(${colour})`; g.lineWidth = 0.5; g.beginPath();
    seen.forEach((p, i) => i ? g.lineTo(p[0], p[1]) : g.moveTo(p[0], p[1])); g.closePath(); g.fill(); g.stroke();
  }
  const length = Math.max(...places.bodies.filter((_, i) => shapes.bodies[i].projected).map(p => Math.hypot(...add(column(p, 3), lens, -1))), 0.5 * view.reach) * 1.15;
  const ends = shapes.cone.map(d => add(lens, turned(projector, d), length));
  ends.forEach((end, i) => { line([lens, end], "#ffd24d99"); line([end, ends[(i + 1) % 4]], "#ffd24d55"); });
  const eye = view.seen(places.eye);
  if (eye) {
    line([places.eye, places.gaze], "#e0a07088");
    g.fillStyle = "#e0a070"; g.beginPath(); g.arc(eye[0], eye[1], Math.max(0.05 * view.reach / view.metresPerPixel(places.eye), 3), 0, 7); g.fill();
  }
  if (room.seen) {
    const [low, high] = room.seen, at = i => [0, 1, 2].map(k => (i >> k & 1 ? high : low)[k]);
    for (let i = 0; i < 8; i++) for (const bit of [1, 2, 4]) if (!(i & bit)) line([at(i), at(i | bit)], "#6cb6ff77");
  }
  g.font = `${12 * density}px system-ui, sans-serif`; g.textAlign = "center"; g.fillStyle = "#93a1b0";
  const label = (at, text) => { const p = view.seen(at); if (p) g.fillText(text, p[0], p[1] - 10 * density); };
  label(add(lens, column(projector, 1), 0.7 * size), "projector"); label(add(places.eye, view.up, 0.05 * view.reach), "observer");
  shapes.bodies.forEach((b, i) => { if (b.tracked) label(column(places.bodies[i], 3), b.tracked); });
}

// The hand: it turns the view, or moves the projector or a body, whose numbers are the parameters of that name.
function roomNames() {
  const names = parameters ? parameters.all.map(p => p.name).filter(n => n === "projector" || n.startsWith("body.")) : [];
  const select = $("room-hand"), now = select.value;
  if ([...select.options].slice(1).map(o => o.value).join("\n") === names.join("\n")) return;
  select.replaceChildren(new Option("turns the view", ""), ...names.map(n => new Option("moves " + n.replace("body.", ""), n)));
  select.value = names.includes(now) ? now : "";
}
function poseOf(name) {
  if (name === "projector") return room.places.projector;
  const i = room.shapes.bodies.findIndex(b => "body." + b.tracked === name);
  return i < 0 ? null : room.places.bodies[i];
}
function handBegins() {
  const name = $("room-hand").value, p = parameters?.all.find(p => p.name === name);
  if (!p || !mayOrder || !room.places) return { name: "" };
  const pose = poseOf(name), turn = scaled(p.numbers.slice(3), Math.PI / 180);
  // The motion is counted along the axes from which it began.
  const axes = [0, 1, 2].map(k => turned(pose, spun([0, 1, 2].map(i => i === k ? 1 : 0), scaled(turn, -1))));
  return { name, p, axes, view: roomView($("room")), at: column(pose, 3), numbers: [...p.numbers] };
}
function handMoves(hand, across, down, isTurning) {
  const { view, axes, p, numbers } = hand, density = window.devicePixelRatio || 1;
  const metres = view.metresPerPixel(hand.at) * density;
  const by = isTurning ? add(scaled(view.up, across), view.right, down).map(v => v * 0.1) : add(scaled(view.right, across), view.up, -down).map(v => v * metres * 1000);
  const along = axes.map(axis => dot(axis, by)), first = isTurning ? 3 : 0;
  const all = numbers.map((n, k) => {
    const { low, high } = p.fields[k], v = k >= first && k < first + 3 ? n + along[k - first] : n;
    return Number(Math.min(Math.max(v, low), high).toFixed(3));
  });
  send(hand.name, all);
}
function startRoom() {
  const canvas = $("room");
  canvas.addEventListener("pointerdown", e => { canvas.setPointerCapture(e.pointerId); room.drag = { x: e.clientX, y: e.clientY, yaw: room.yaw, pitch: room.pitch, hand: handBegins() }; });
  canvas.addEventListener("pointermove", e => {
    const drag = room.drag;
    if (!drag) return;
    const across = e.clientX - drag.x, down = e.clientY - drag.y;
    if (drag.hand.name) return handMoves(drag.hand, across, down, e.shiftKey);
    room.yaw = drag.yaw - across * 0.008; room.pitch = Math.min(Math.max(drag.pitch + down * 0.008, -1.5), 1.5);
    drawRoomSoon();
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => { room.drag = null; });
  canvas.addEventListener("wheel", e => { e.preventDefault(); room.zoom = Math.min(Math.max(room.zoom * Math.exp(-e.deltaY * 0.0012), 0.3), 8); drawRoomSoon(); }, { passive: false });
  canvas.addEventListener("keydown", e => {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[e.key], isZoom = e.key === "+" || e.key === "-";
    if (!step && !isZoom) return;
    e.preventDefault();
    const hand = step ? handBegins() : { name: "" };
    if (hand.name) handMoves(hand, ...step, e.shiftKey);
    else if (step) { room.yaw -= step[0] * 0.1; room.pitch = Math.min(Math.max(room.pitch + step[1] * 0.1, -1.5), 1.5); }
    else room.zoom = Math.min(Math.max(room.zoom * (e.key === "+" ? 1.15 : 1 / 1.15), 0.3), 8);
    drawRoomSoon();
  });
  window.addEventListener("resize", drawRoomSoon);
}
