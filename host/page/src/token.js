// What the live page and the page of a calibration share: the token.
// The secret for orders comes in the part of the link that no browser sends, and goes from there.
const KEY = "dpm-token";
const fromLink = /[#&]token=([0-9a-f]{64})/.exec(location.hash);
if (fromLink) { localStorage.setItem(KEY, fromLink[1]); history.replaceState(null, "", location.pathname); }
let token = localStorage.getItem(KEY);
// True if the rig takes orders with the token that this browser has; null if the rig does not answer.
async function tokenHolds() {
  if (!token) return false;
  try { return (await fetch("/api/token", { headers: { "X-Dpm-Token": token } })).ok; } catch { return null; }
}
function onToken(check) {
  $("token").addEventListener("submit", e => { e.preventDefault(); token = $("secret").value.trim(); localStorage.setItem(KEY, token); $("secret").value = ""; check(); });
}
