// What the live page and the page of a calibration share: page and rig prove to each other that they have the same key (proof.rs).
// The key comes in the part of the link that no browser sends, goes from there, and is kept as text nowhere. The key that signs orders
// lives as long as this page. The one that verifies the rig is kept, since whoever serves the next page can sign nothing with it.
const HMAC = { name: "HMAC", hash: "SHA-256" };
const utf8 = text => new TextEncoder().encode(text);
const hexOf = bytes => Array.from(new Uint8Array(bytes), b => b.toString(16).padStart(2, "0")).join("");
const bytesOf = hex => Uint8Array.from(hex.match(/../g) || [], two => parseInt(two, 16));
const drawn = () => hexOf(crypto.getRandomValues(new Uint8Array(16)));
let orderKey = null, rigKey = null;
class NotTheRig extends Error {}

function kept(act) {
  return new Promise((done, failed) => {
    const open = indexedDB.open("dpm-page", 1);
    open.onupgradeneeded = () => open.result.createObjectStore("keys");
    open.onerror = () => failed(open.error);
    open.onsuccess = () => {
      const request = act(open.result.transaction("keys", "readwrite").objectStore("keys"));
      request.onsuccess = () => { open.result.close(); done(request.result); };
      request.onerror = () => { open.result.close(); failed(request.error); };
    };
  });
}
async function derived(secret, text, usage) {
  return crypto.subtle.importKey("raw", await crypto.subtle.sign("HMAC", secret, utf8(text)), HMAC, false, [usage]);
}
async function readKey() {
  const found = /[#&]key=([0-9a-f]{64})/.exec(location.hash);
  if (found) history.replaceState(null, "", location.pathname);
  // Over plain HTTP a browser gives keys to pages of this machine only.
  if (!crypto.subtle) return;
  if (found) {
    const secret = await crypto.subtle.importKey("raw", bytesOf(found[1]), HMAC, false, ["sign"]);
    orderKey = await derived(secret, "dpm page: orders", "sign");
    rigKey = await derived(secret, "dpm page: rig", "verify");
  }
  // A browser that keeps nothing verifies the rig until the page is left.
  try { if (found) await kept(keys => keys.put(rigKey, "rig")); else rigKey = await kept(keys => keys.get("rig")) || null; } catch { /* See above. */ }
  document.body.classList.toggle("unproven", !rigKey);
}
let keysReady = readKey();

// True if `proof` is the rig's signature of a text and the bytes behind it.
async function isProven(proof, text, bytes = new Uint8Array()) {
  const head = utf8(text), all = new Uint8Array(head.length + bytes.length);
  all.set(head); all.set(bytes, head.length);
  return crypto.subtle.verify("HMAC", rigKey, bytesOf(proof || ""), all);
}
// Asks the rig, and for what does something with a signature. Throws NotTheRig where the answer is not proven although the key is here.
async function asked(method, where, isSigned) {
  await keysReady;
  const url = new URL(where, location.href), path = url.pathname + url.search, number = drawn(), headers = { "X-Dpm-Number": number };
  if (isSigned && orderKey) {
    const { text: challenge, ok } = await asked("GET", "/api/challenge");
    if (ok) headers["X-Dpm-Order"] = challenge + " " + hexOf(await crypto.subtle.sign("HMAC", orderKey, utf8(`${method}\n${path}\n${challenge}\n`)));
  }
  const r = await fetch(path, { method, headers, signal: AbortSignal.timeout(5000) });
  const body = new Uint8Array(await r.arrayBuffer());
  if (rigKey && !await isProven(r.headers.get("X-Dpm-Proof"), `answer\n${method}\n${path}\n${number}\n${r.status}\n`, body)) throw new NotTheRig();
  return { ok: r.ok, status: r.status, text: new TextDecoder().decode(body) };
}
// True if the rig takes orders by the key of this page; null if it does not answer.
async function keyHolds() {
  await keysReady;
  if (!orderKey) return false;
  try { return (await asked("GET", "/api/key", true)).ok; } catch (e) { if (e instanceof NotTheRig) throw e; return null; }
}
function onKey(check) {
  window.addEventListener("hashchange", () => { if (location.hash) { keysReady = readKey(); check(); } });
}
