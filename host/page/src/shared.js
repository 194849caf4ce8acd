// What all pages share.
const $ = id => document.getElementById(id);
function span(name, text) { const s = document.createElement("span"); s.className = name; s.textContent = text; return s; }
// The class of a projector's state, from its word in any case; shared.css has the colours.
const CLASSES = { up: "up", safe: "bad", frozen: "frozen", lost: "bad blink", faulted: "bad", interlock: "warn", resting: "warn", connecting: "warn" };
const stateClass = word => "word " + (Object.hasOwn(CLASSES, word.toLowerCase()) ? CLASSES[word.toLowerCase()] : "");
const share = v => v === 0 ? "0 %" : v < 0.0001 ? "< 0.01 %" : (v * 100).toFixed(v < 0.1 ? 2 : 1) + " %";
