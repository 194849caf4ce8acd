// What all pages share.
const $ = id => document.getElementById(id);
function span(name, text) { const s = document.createElement("span"); s.className = name; s.textContent = text; return s; }
// The class of the state of the light, from its word; shared.css has the colours.
const CLASSES = { "LIT": "up", "PARTLY LIT": "warn", "DARK BY ORDER": "", "DARK": "bad", "STALLED": "bad blink", "NEVER ARMED": "warn" };
const stateClass = word => "word " + (Object.hasOwn(CLASSES, word) ? CLASSES[word] : "");
const share = v => v === 0 ? "0 %" : v < 0.0001 ? "< 0.01 %" : (v * 100).toFixed(v < 0.1 ? 2 : 1) + " %";
